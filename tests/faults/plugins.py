"""Runs one cell of the faults of plugins."""

from __future__ import annotations

import signal
import time
from pathlib import Path

from launching import Running

from .cells import Cell, Kind
from .trials import ENDS_WITHIN_S, GIVES_UP_AFTER_S, Expected, Outcome, Place, Trial, read_to_end

DRAINS_WITHIN_S = 5.0
DURATION_S = 1.5
_LOOKS_FOR_S = 1.0
_CUT_SHORT = "had to be killed after 5 s without progress"


def place_of(cell: Cell) -> Place:
    """Where a cell stands in the tables."""
    return Place(f"faults of plugins, {cell.backend}", cell.fault, cell.place)


def run(cell: Cell, folder: Path, *, flood_bytes: int, within_s: float = ENDS_WITHIN_S) -> Outcome:
    """Run a cell in an empty folder and judge it.

    Args:
        flood_bytes: how much ``flood_output`` writes.
        within_s: a run that takes longer to end is late; where nodes drain, 5 s more.
    """
    trial = Trial(folder, cell.fault, cell.place, flood_bytes)
    with trial.start(cell.backend, duration_s=DURATION_S) as running:
        due_s = _end_is_due(cell, trial, running)
        expected = Expected(
            cell.exit_codes,
            last_says="" if cell.is_survived or cell.needs_interrupt else "victim",
            within_s=GIVES_UP_AFTER_S,
            has_traceback=_has_traceback(cell),
        )
        outcome = trial.outcome(place_of(cell), running, due_s, expected)
    if trial.struck_s is None:
        outcome.problems.append("no fault struck before the end of the run")
    if outcome.exit_code and cell.may_be_cut_short and _CUT_SHORT not in outcome.said:
        outcome.problems.append(f"exit code {outcome.exit_code}, but not cut short")
    if cell.ends_by_itself and outcome.record:
        # Both count from time 0 of the run.
        outcome.took_s = outcome.record["wall_s"] - DURATION_S
    drains_s = DRAINS_WITHIN_S if cell.ends_by_itself and not cell.is_survived else 0.0
    outcome.is_late = outcome.took_s > within_s + drains_s
    return outcome


def _has_traceback(cell: Cell) -> bool | None:
    """Python ends just the thread that calls ``sys.exit``; of other faults a stack is shown."""
    is_silent = cell.fault == "sys_exit" and cell.place == "thread"
    return True if cell.kind is Kind.RAISES and not is_silent else None


def _end_is_due(cell: Cell, trial: Trial, running: Running) -> float:
    """Wait for the fault; returns when the end is due by the rules, on the monotonic clock."""
    struck_s = trial.await_strike(running)
    if cell.backend == "docker":
        _strike_from_outside(cell.fault, trial)
    if cell.needs_interrupt:
        read_to_end(running, struck_s + _LOOKS_FOR_S)
        running.signal(signal.SIGINT)
        return time.monotonic()
    return struck_s


def _strike_from_outside(fault: str, trial: Trial) -> None:
    """The faults that process 1 of a container cannot do to itself."""
    if fault not in ("kill", "stop_and_continue"):
        return
    for process in trial.processes():
        if Path(process.environ().get("NEUROS_RUN_DIR", "")).name != "victim":
            continue
        if fault == "kill":
            process.kill()
        else:
            process.suspend()
            time.sleep(1.0)
            process.resume()
        return
