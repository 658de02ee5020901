"""Two nodes whose libraries exclude each other, in two versions of Python, as one project."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from launching import EXAMPLES, launch
from needs import cannot_run

from containers import connected
from neuros.backends.docker.images import Image, images_for
from neuros.errors import EnvironmentFault

CONFLICT = EXAMPLES / "5_containers/conflict"
CONTAINERS = ("statemachine_0", "statemachine_2")


@pytest.fixture(scope="module")
def images() -> dict[str, Image]:
    """The images of the example, which are built on demand only."""
    try:
        with connected() as engine:
            return images_for(CONTAINERS, CONFLICT, engine)
    except EnvironmentFault as fault:
        cannot_run("containers", str(fault))


def test_they_exchange_packets_and_each_runs_its_own_versions(
    images: dict[str, Image], tmp_path: Path
) -> None:
    old, new = (".".join(map(str, images[name].python_version)) for name in CONTAINERS)
    assert old != new
    run = launch(CONFLICT, "--backend", "docker", cwd=tmp_path, timeout_s=60.0)
    assert run.exit_code == 0, run.output
    for node, library, python in (("gripper", 0, old), ("planner", 2, new)):
        versions = rf"I run python-statemachine {library}\.\S+ on Python {re.escape(python)}\.\d+"
        assert re.fullmatch(versions, run.said(node)[0])
    for counters in run.record["connections"]:
        assert counters["sent"] == counters["received"] == 100
