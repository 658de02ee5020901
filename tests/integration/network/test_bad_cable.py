"""A lossless connection over a cable that loses, delays, reorders and doubles frames, or is out.

``python -m tests.integration.network`` streams more, and makes the table of docs/network.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from cable import Cable
from conditions import CONDITIONS, stream
from two_machines import TwoMachines, two_machines

_QUICK = ("10 % lost, 10 % twice, 0 to 40 ms late", "out for 2 s")


@pytest.fixture(scope="module")
def cable() -> Cable:
    return Cable()


@pytest.fixture(scope="module")
def machines(cable: Cable) -> Iterator[TwoMachines]:
    with two_machines(cable) as machines:
        yield machines


def check(machines: TwoMachines, cable: Cable, name: str, folder: Path) -> None:
    assert stream(machines, cable, CONDITIONS[name], folder, count=100, size=0).problems == []


@pytest.mark.parametrize("name", _QUICK)
def test_every_packet_arrives_once_and_in_order(
    machines: TwoMachines, cable: Cable, name: str, tmp_path: Path
) -> None:
    check(machines, cable, name, tmp_path)


@pytest.mark.acceptance
@pytest.mark.parametrize("name", [name for name in CONDITIONS if name not in _QUICK])
def test_on_every_cable(machines: TwoMachines, cable: Cable, name: str, tmp_path: Path) -> None:
    check(machines, cable, name, tmp_path)
