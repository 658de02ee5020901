"""Faults of NeuROS's own processes, of the surroundings of a run, and Ctrl+C at any moment.

Here is what no other test has; ``python -m tests.faults`` runs all cells.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from engines import require_engines
from machines import require_machines
from needs import require

from containers import require_containers

from . import interrupts, processes, surroundings
from .interrupts import Interrupt
from .launches import launches
from .processes import ProcessFault, process_faults
from .surroundings import SurroundingCell
from .trials import Outcome

# Others are in tests/integration: killed launchers and recorders, and engines that go away.
_FAULTS = (
    ProcessFault("stopped for 2 s", "launcher", "running", "process"),
    ProcessFault("SIGTERM", "launcher", "ending", "in-process"),
    ProcessFault("SIGSEGV", "guardian", "running", "process"),
    ProcessFault("kill -9", "recorder", "ending", "in-process"),
    ProcessFault("SIGTERM", "dashboard", "running", "in-process"),
)
_SURROUNDINGS = tuple(
    each
    for each in surroundings.surroundings()
    if str(each.place).startswith(
        (
            "terminal closed at in-process",
            "run folder full while running at process",
            "shared memory full at process",
            "temporary folder without inodes at process",
            "64 file descriptors at in-process",
            "clock set back by an hour at process",
        )
    )
)
_INTERRUPTS = (
    Interrupt(1, 0.6, "process"),
    Interrupt(2, 1.2, "in-process"),
    Interrupt(10, 0.9, "process"),
)


def check(trial: Callable[[Path], Outcome], folder: Path) -> None:
    """A late end is the run's, or comes of what else the machine did: once more tells."""
    outcome = trial(folder)
    if outcome.is_late:
        (folder / "again").mkdir()
        outcome = trial(folder / "again")
    assert outcome.is_well, f"{outcome}\n{outcome.output[-5000:]}"


def check_process(fault: ProcessFault, folder: Path) -> None:
    if fault.target == "engine":
        require_engines()
    elif fault.backend == "docker":
        require_containers()
    check(partial(processes.run, fault), folder)


def check_surrounding(cell: SurroundingCell, folder: Path) -> None:
    require_machines()
    require("gcc", "ip")
    if cell.backend == "docker":
        require_containers()
    check(partial(surroundings.run, cell), folder)


@pytest.mark.parametrize("fault", _FAULTS, ids=str)
def test_a_run_outlives_its_other_processes_and_ends_with_its_launcher(
    fault: ProcessFault, tmp_path: Path
) -> None:
    check_process(fault, tmp_path)


@pytest.mark.parametrize("cell", _SURROUNDINGS, ids=str)
def test_surroundings_end_a_run_only_where_they_must(cell: SurroundingCell, tmp_path: Path) -> None:
    check_surrounding(cell, tmp_path)


@pytest.mark.parametrize("interrupt", _INTERRUPTS, ids=str)
def test_ctrl_c_ends_a_run_at_any_moment(interrupt: Interrupt, tmp_path: Path) -> None:
    check(partial(interrupts.run, interrupt), tmp_path)


def test_many_launches_are_all_alike_and_leave_nothing(tmp_path: Path) -> None:
    assert list(launches(tmp_path, 5)) == []


@pytest.mark.acceptance
@pytest.mark.parametrize("fault", [*process_faults()], ids=str)
def test_every_fault_of_a_process(fault: ProcessFault, tmp_path: Path) -> None:
    check_process(fault, tmp_path)


@pytest.mark.acceptance
@pytest.mark.parametrize("cell", [*surroundings.surroundings()], ids=str)
def test_every_surrounding(cell: SurroundingCell, tmp_path: Path) -> None:
    check_surrounding(cell, tmp_path)
