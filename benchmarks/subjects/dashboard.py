"""What a dashboard costs a run: off, on with nobody looking, open with an array drawn, and with the
world in 3-D as well.

WhiskEye, strict, a process per node. Whoever looks is a thread of this program, not a browser: what
a browser takes to draw is not a cost of NeuROS.
"""

from __future__ import annotations

import functools
import resource

from benchmarks.live import live
from benchmarks.measure import MINIMUM_PAIRS, Case, Figure, Group, Measurement, Subject
from benchmarks.subjects.whiskeye import RATE, SIMULATED_S, SLICES, WHISKEYE
from benchmarks.viewer import Drawn, viewing
from neuros.control import WORLD

OFF, CLOSED, OPEN, IN_3D = "off", "closed", "open", "3-D"
WORK = "processor_s"
DRAWN: Drawn = {"robot": {"imu": ["orientation_covariance"]}}
SHOWN: dict[str, Drawn] = {OPEN: DRAWN, IN_3D: {"robot": {**DRAWN["robot"], WORLD: []}}}
SEEN = ("figures", "samples")


def subject(is_quick: bool) -> Subject:
    """Simulated seconds per run."""
    simulated_s = SIMULATED_S * (0.2 if is_quick else 1.0)
    candidates: dict[str, Measurement] = {
        state: functools.partial(whiskeye, state, simulated_s)
        for state in (OFF, CLOSED, OPEN, IN_3D)
    }
    cases = tuple(
        Case(
            f"whiskeye strict, process, dashboard {label}: {what}",
            unit,
            Figure(state, figure),
            Figure(OFF, figure),
            "without",
        )
        for state, label in (
            (CLOSED, "on, nobody looks"),
            (OPEN, "open"),
            (IN_3D, "open, in 3-D"),
        )
        for what, unit, figure in (
            ("real-time factor", "", RATE),
            ("processor time of the whole run", "s", WORK),
        )
    )
    return Subject(
        "what a dashboard costs a run", (Group(candidates, cases, MINIMUM_PAIRS, SLICES),)
    )


def whiskeye(state: str, simulated_s: float) -> dict[str, float]:
    """Speed without initialisation and ending, and processor time with them.

    Raises:
        RuntimeError: if the run fails, or nothing was seen of it on an open dashboard.
    """
    before_s = _worked_s()
    with live(
        WHISKEYE / "strict.json",
        "process",
        {"nodes.robot.environment.DURATION": simulated_s},
        () if state == OFF else ("--dashboard",),
    ) as run:
        if state in SHOWN:
            with viewing(run.printed(r"dashboard: (\S+)\n"), SHOWN[state]) as viewer:
                record = run.finished()
            if not all(viewer.counts.get(event) for event in SEEN):
                raise RuntimeError(f"the dashboard has shown {viewer.counts}")
        else:
            record = run.finished()
    return {RATE: float(record[RATE]), WORK: _worked_s() - before_s}


def _worked_s() -> float:
    """Processor time of the processes that have ended, started by this one or by them."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
