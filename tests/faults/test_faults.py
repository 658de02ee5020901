"""Whatever goes wrong in a plugin: the run ends as it must, in time, and leaves nothing.

Here each fault strikes once; ``python -m tests.faults`` runs all cells.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from containers import require_containers

from .cells import BACKENDS, FAULTS, PLACES, Cell, all_cells
from .plugins import run

_FLOOD_BYTES = 1 << 24
# Twice what docs/faults.md promises: the other tests have the machine, too.
_ENDS_WITHIN_S = 12.0
_ROUND = tuple(
    Cell(fault, place, backend)
    for fault, place, backend in zip(
        FAULTS, itertools.cycle(PLACES), itertools.cycle(BACKENDS[:2]), strict=False
    )
)


def check(cell: Cell, folder: Path) -> None:
    if cell.backend == "docker":
        require_containers()
    outcome = run(cell, folder, flood_bytes=_FLOOD_BYTES, within_s=_ENDS_WITHIN_S)
    assert outcome.is_well, f"{outcome}\n{outcome.output[-5000:]}"


@pytest.mark.parametrize("cell", _ROUND, ids=str)
def test_a_fault_ends_the_run_as_it_must(cell: Cell, tmp_path: Path) -> None:
    check(cell, tmp_path)


@pytest.mark.parametrize("fault", ["kill", "close_descriptors"])
def test_in_a_container_too(fault: str, tmp_path: Path) -> None:
    check(Cell(fault, "function", "docker"), tmp_path)


@pytest.mark.acceptance
@pytest.mark.parametrize("cell", [each for each in all_cells() if each not in _ROUND], ids=str)
def test_every_cell(cell: Cell, tmp_path: Path) -> None:
    check(cell, tmp_path)
