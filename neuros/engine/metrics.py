"""Metrics of an engine: the states that its wall time is counted by, and intervals of ticks.

Between two events nothing of a node changes, so the time between them has one cause, which is
asked for once, when the next event arrives.
"""

from __future__ import annotations

from collections import Counter
from enum import Enum
from math import sqrt
from typing import Any, NamedTuple

WITHIN_MS = (1, 2, 5, 10)
"""Shares are given of intervals that are off the period by no more than this."""

_BIN_NS = 100_000
_MOST_BINS = 20_000


class State(str, Enum):
    """The state of a node at a moment."""

    REGISTERING = "registering"
    EXECUTING = "executing"
    WAITING = "waiting"
    BLOCKED = "blocked"
    IDLE = "idle"
    SCHEDULING = "scheduling"
    PAUSED = "paused"

    __hash__ = str.__hash__  # time is counted at every event, and Enum's own is ten times slower


class Rest(NamedTuple):
    """The state of a node, and the hook, input or connection that causes it."""

    state: State
    cause: str = ""


REGISTERING = Rest(State.REGISTERING)
SCHEDULING = Rest(State.SCHEDULING)
IDLE = Rest(State.IDLE)
PAUSED = Rest(State.PAUSED)


def in_flight_and_lost(
    sent: int, received: int, outstanding: int, has_drained: bool
) -> tuple[int, int]:
    """Packets of a connection that had not arrived when a run ended: in flight, and lost.

    Nodes of a run that is not drained stop one after the other, and what one sends to another that
    has stopped arrives nowhere. Only outstanding packets can be among these: all others of a
    reliable connection have arrived, and on one of best effort nobody can tell the two apart.
    """
    missing = sent - received
    in_flight = 0 if has_drained else max(0, min(missing, outstanding))
    return in_flight, missing - in_flight


class TickIntervals:
    """Intervals between the starts of one timed hook, in a memory that does not grow with them.

    Args:
        period_ns: what the intervals should be.
    """

    __slots__ = (
        "_bins",
        "_last_ns",
        "_longest_ns",
        "_period_ns",
        "_shortest_ns",
        "_squares",
        "_sum_ns",
        "_within",
        "count",
    )

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._last_ns: int | None = None
        self.count = 0
        self._sum_ns = 0
        self._squares = 0
        self._shortest_ns = 0
        self._longest_ns = 0
        self._within = [0] * len(WITHIN_MS)
        self._bins: Counter[int] = Counter()

    def note(self, start_ns: int) -> None:
        """The hook starts."""
        last_ns, self._last_ns = self._last_ns, start_ns
        if last_ns is None:
            return
        interval_ns = start_ns - last_ns
        if not self.count or interval_ns < self._shortest_ns:
            self._shortest_ns = interval_ns
        if interval_ns > self._longest_ns:
            self._longest_ns = interval_ns
        self.count += 1
        error_ns = interval_ns - self._period_ns
        self._sum_ns += error_ns
        self._squares += error_ns * error_ns
        for place, within_ms in enumerate(WITHIN_MS):
            if -within_ms * 1_000_000 <= error_ns <= within_ms * 1_000_000:
                self._within[place] += 1
        self._bins[min(interval_ns // _BIN_NS, _MOST_BINS)] += 1

    def skip(self, duration_ns: int) -> None:
        """Leave a time out of the current interval."""
        if self._last_ns is not None:
            self._last_ns += duration_ns

    def figures(self) -> dict[str, Any] | None:
        """Statistics of the intervals, ready for JSON; ``None`` before the second tick.

        ``histogram`` is a list of ``[from_ms, count]``, in bins of 0.1 ms; what is above 2 s is in
        the last one. ``largest_error_ms`` is how far the worst interval was off the period.
        """
        count = self.count
        if not count:
            return None
        mean_ns = self._sum_ns / count
        variance = max(0.0, self._squares / count - mean_ns * mean_ns)
        period_ns = self._period_ns
        worst_ns = max(self._longest_ns - period_ns, period_ns - self._shortest_ns)
        return {
            "period_ms": period_ns / 1e6,
            "intervals": count,
            "mean_ms": (period_ns + mean_ns) / 1e6,
            "std_ms": sqrt(variance) / 1e6,
            "min_ms": self._shortest_ns / 1e6,
            "max_ms": self._longest_ns / 1e6,
            "largest_error_ms": worst_ns / 1e6,
            "within": {
                f"{within_ms} ms": hits / count
                for within_ms, hits in zip(WITHIN_MS, self._within, strict=True)
            },
            "histogram": [
                [number * _BIN_NS / 1e6, hits] for number, hits in sorted(dict(self._bins).items())
            ],
        }
