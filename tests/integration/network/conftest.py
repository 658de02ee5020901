"""Two machines for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from engines import require_engines
from two_machines import TwoMachines, two_machines

from containers import IMAGES


@pytest.fixture(scope="session")
def joined() -> Iterator[TwoMachines]:
    with two_machines() as machines:
        yield machines


@pytest.fixture(scope="session")
def with_engines(joined: TwoMachines) -> Iterator[TwoMachines]:
    require_engines(*IMAGES)
    with joined.engines():
        yield joined


@pytest.fixture(params=["process", pytest.param("docker", marks=pytest.mark.acceptance)])
def backend(request: pytest.FixtureRequest) -> str:
    """What nodes run on: containers, too, among the long runs."""
    return str(request.param)


@pytest.fixture
def machines(backend: str, request: pytest.FixtureRequest) -> Iterator[TwoMachines]:
    """Joined by a cable that loses nothing and lets multicast pass."""
    machines: TwoMachines = request.getfixturevalue(
        "with_engines" if backend == "docker" else "joined"
    )
    yield machines
    machines.repair()
    assert not machines.containers()
