"""WhiskEye, strict, in one process: what of a cycle NeuROS takes, and what its messages do.

Measured within a run (:mod:`benchmarks.cycles`), where the ``whiskeye`` subject compares runs. The
hooks called by hand are what an engine that takes no time at all could reach: there is nothing but
the user's functions and the ROS messages that they make, fill and read.
"""

from __future__ import annotations

import functools

from benchmarks.cycles import APART, HAND, NEUROS, speeds
from benchmarks.measure import Case, Figure, Group, Subject
from benchmarks.subjects.whiskeye import WHISKEYE

SIMULATED_S = 60.0
ROWS = {
    NEUROS: "NeuROS, share of the speed of one loop",
    HAND: "its hooks called by hand, share of the speed of one loop",
    APART: "its hooks called by hand, each in its node's context, share of the speed of one loop",
    "around hooks": "NeuROS, share of the speed of its hooks called by hand",
}


def subject(is_quick: bool) -> Subject:
    """Simulated seconds per run."""
    simulated_s = 0.3 * SIMULATED_S if is_quick else SIMULATED_S
    settings = {"nodes.robot.environment.DURATION": simulated_s}
    run = "strict, in process"
    cases = tuple(
        Case(f"whiskeye {run}, within a run: {text}", "", Figure(run, name))
        for name, text in ROWS.items()
    )
    measure = functools.partial(speeds, WHISKEYE / "strict.json", settings)
    return Subject(
        "a cycle of WhiskEye in one process, without NeuROS in turn",
        (Group({run: measure}, cases),),
    )
