"""Cost of the metrics of a run: times and digests of packets, the time budget, the timeline.

WhiskEye, strict. Each run is measured with metrics and without, in turn
(:mod:`benchmarks.in_turn`). In process one thread does all work, so its processor time says more
than the wall clock of a busy machine.
"""

from __future__ import annotations

import functools

from benchmarks.in_turn import speed_with
from benchmarks.measure import Case, Figure, Group, Measurement, Subject
from benchmarks.subjects.whiskeye import WHISKEYE

SIMULATED_S = 60.0
SLICE_S = 0.2
RUNS = {
    "in process": ("in-process", (), "work", "ledger"),
    "in process, with --digests": ("in-process", ("--digests",), "work", None),
    "process": ("process", (), "speed", None),
}


def subject(is_quick: bool) -> Subject:
    """Simulated seconds per run."""
    simulated_s = 0.2 * SIMULATED_S if is_quick else SIMULATED_S
    candidates: dict[str, Measurement] = {
        name: functools.partial(
            speed_with,
            "ledger",
            WHISKEYE / "strict.json",
            backend,
            SLICE_S,
            {"nodes.robot.environment.DURATION": simulated_s},
            options,
        )
        for name, (backend, options, _, _) in RUNS.items()
    }
    cases = tuple(
        Case(
            f"whiskeye strict, {name}, with metrics: share of the speed without metrics",
            "",
            Figure(name, figure),
            bound=bound,
        )
        for name, (_, _, figure, bound) in RUNS.items()
    )
    return Subject("cost of the metrics of a run", (Group(candidates, cases),))
