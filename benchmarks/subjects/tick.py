"""How regular a tick is: a hook that notes the time, against a timer of bare rclpy that does.

The schedule is the one that fits best: what all ticks are late by does not count, on either side.
"""

from __future__ import annotations

import functools
import statistics
from collections.abc import Sequence

from benchmarks.bare_nodes import results
from benchmarks.graphs import run
from benchmarks.measure import MINIMUM_PAIRS, Case, Figure, Group, Subject

JUDGED_MS = 20
PERIODS_MS = (1, 5, JUDGED_MS, 100)
SECONDS = {1: 2.0, 5: 2.0, JUDGED_MS: 4.0, 100: 4.0}
FEWER_ROUNDS = 5
TOLERANCE_NS = 1_000_000
BARE = "rclpy timer"


def subject(is_quick: bool) -> Subject:
    """A few seconds of ticks per run."""
    return Subject(
        "regularity of ticks every 1, 5, 20 and 100 ms",
        tuple(_period(period_ms, 0.2 if is_quick else 1.0) for period_ms in PERIODS_MS),
    )


def _period(period_ms: int, share: float) -> Group:
    period_s = period_ms / 1e3
    count = round(share * SECONDS[period_ms] / period_s)
    candidates = {
        "process": functools.partial(ticks, "process", period_s, count),
        "in process": functools.partial(ticks, "in-process", period_s, count),
        BARE: functools.partial(bare_ticks, period_s, count),
    }
    is_judged = period_ms == JUDGED_MS
    cases = []
    for label in ("process", "in process"):
        bounds = (
            ("tick-share", "tick-deviation") if is_judged and label == "process" else (None,) * 2
        )
        name = f"tick every {period_ms} ms, {label}"
        cases += [
            Case(
                f"{name}, share within 1 ms",
                "",
                Figure(label, "share"),
                Figure(BARE, "share"),
                BARE,
                bounds[0],
            ),
            Case(
                f"{name}, standard deviation",
                "us",
                Figure(label, "deviation"),
                Figure(BARE, "deviation"),
                BARE,
                bounds[1],
            ),
        ]
    return Group(candidates, tuple(cases), MINIMUM_PAIRS if is_judged else FEWER_ROUNDS)


def ticks(backend: str, period_s: float, count: int) -> dict[str, float]:
    """Share of the ticks within 1 ms of their schedule; standard deviation from it (us)."""
    node = {
        "name": "ticker",
        "container": "neuros_python",
        "plugin": "ticker.py",
        "environment": {"PERIOD_S": str(period_s), "COUNT": str(count)},
    }
    (moments_ns,) = run([node], [], backend, ["ticker"])
    return regularity(moments_ns, period_s)


def bare_ticks(period_s: float, count: int) -> dict[str, float]:
    """The same with a timer in ``rclpy.spin``."""
    timer = {"role": "timer", "period_s": period_s, "count": count}
    (moments_ns,) = results([[timer]], [0])
    return regularity(moments_ns, period_s)


def regularity(moments_ns: Sequence[int], period_s: float) -> dict[str, float]:
    """What :func:`ticks` returns. A tick that did not come was not in time."""
    period_ns = round(period_s * 1e9)
    start_ns = moments_ns[0]
    for _ in range(2):  # the first tick may be a late one
        numbers = [round((moment - start_ns) / period_ns) for moment in moments_ns]
        late_ns = [
            moment - start_ns - number * period_ns
            for moment, number in zip(moments_ns, numbers, strict=True)
        ]
        start_ns += round(statistics.median(late_ns))
    late_ns = [
        moment - start_ns - number * period_ns
        for moment, number in zip(moments_ns, numbers, strict=True)
    ]
    in_time = {n for n, late in zip(numbers, late_ns, strict=True) if abs(late) <= TOLERANCE_NS}
    return {
        "share": len(in_time) / (numbers[-1] - numbers[0] + 1),
        "deviation": statistics.pstdev(late_ns) / 1e3,
    }
