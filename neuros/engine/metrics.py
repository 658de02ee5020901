"""Metrics of an engine: the states that its wall time is counted by, and intervals of ticks.

Between two events the state of a node does not change, so the time between them has one cause.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from math import sqrt
from typing import Any, NamedTuple

WITHIN_MS = (1, 2, 5, 10)
"""Limits of the error of an interval, for which figures have the share of intervals."""

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

    __hash__ = str.__hash__  # used at every event; Enum's own is ten times slower


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
    """The packets of a connection that had not arrived at the end of a run: in flight, and lost.

    Nodes of a run that does not drain stop one after the other, and a packet to a stopped node is
    in flight for ever. Only outstanding packets can be: the others of a reliable connection have
    arrived, and on a best-effort connection the two cannot be told apart.
    """
    missing = sent - received
    in_flight = 0 if has_drained else max(0, min(missing, outstanding))
    return in_flight, missing - in_flight


class TickIntervals:
    """Statistics of the intervals between the starts of a timed hook, in constant memory.

    Args:
        period_ns: the nominal interval.
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

    def record(self, start_ns: int) -> None:
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
        """Leave a duration out of the current interval."""
        if self._last_ns is not None:
            self._last_ns += duration_ns

    def figures(self) -> dict[str, Any] | None:
        """The statistics, ready for JSON; ``None`` before the second tick.

        ``histogram`` is a list of ``[from_ms, count]`` in bins of 0.1 ms; the last bin has all
        intervals above 2 s. ``largest_error_ms`` is the largest difference from the period.
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


# ---------------------------------------------------------------------- time budget
#
# The budget covers the time from the end of the last initialisation until the end of the run was
# requested (``running_s`` of ``run.json``). Scheduling time is that in which a hook may start, and
# waits for its turn: in one process, hooks of other nodes run then.


@dataclass(frozen=True)
class TimeBudget:
    """The wall time of a node, in seconds.

    Attributes:
        executing: by hook.
        waiting: by input.
        blocked: by connection.
        idle_s: between ticks.
    """

    executing: Mapping[str, float]
    waiting: Mapping[str, float]
    blocked: Mapping[str, float]
    idle_s: float
    scheduling_s: float

    @property
    def executing_s(self) -> float:
        return sum(self.executing.values())

    @property
    def own_s(self) -> float:
        """Seconds of hooks and scheduling, which do not depend on other nodes."""
        return self.executing_s + self.scheduling_s

    @property
    def busiest_hook(self) -> tuple[str, float]:
        """The hook with most seconds, and these; an empty name if there is none."""
        return max(self.executing.items(), key=lambda item: item[1], default=("", 0.0))

    @property
    def total_s(self) -> float:
        rest = sum(self.waiting.values()) + sum(self.blocked.values()) + self.idle_s
        return self.own_s + rest

    def share(self, seconds: float) -> float:
        """Seconds as a share of the sum, from 0 to 1."""
        return seconds / (self.total_s or 1.0)

    @property
    def shares(self) -> dict[str, float]:
        """Executing, waiting, blocked and idle; the rest to 1 is scheduling."""
        return {
            "executing": self.share(self.executing_s),
            "waiting": self.share(sum(self.waiting.values())),
            "blocked": self.share(sum(self.blocked.values())),
            "idle": self.share(self.idle_s),
        }


def time_budget_of(node: Mapping[str, Any], running_s: float | None) -> TimeBudget | None:
    """The time budget of a node of ``run.json``; ``None`` if the node has not reported.

    The accounting of a node begins when the node does. Without initialise hooks, its surplus over
    ``running_s`` is the wait for nodes that began later, and for the end. The surplus is subtracted
    from the longest causes, since sums do not show which cause it was.
    """
    accounting = node.get("accounting")
    if not accounting:
        return None
    hooks = node.get("hooks") or {}
    executing: dict[str, float] = {}
    for name, busy_s in (accounting.get("executing") or {}).items():
        # A function may be an initialise hook and another one.
        rest_s = (busy_s or 0.0) - (hooks.get(name, {}).get("initialise_s") or 0.0)
        if rest_s > 0:
            executing[name] = rest_s
    rests = {
        (state, name): s or 0.0
        for state in ("waiting", "blocked")
        for name, s in (accounting.get(state) or {}).items()
    }
    rests |= {(state, ""): accounting.get(state) or 0.0 for state in ("idle", "scheduling")}
    if running_s:
        surplus_s = sum(executing.values()) + sum(rests.values()) - running_s
        for cause in sorted(rests, key=lambda cause: rests[cause], reverse=True):
            moved_s = min(max(surplus_s, 0.0), rests[cause])
            rests[cause] -= moved_s
            surplus_s -= moved_s

    def of(state: str) -> dict[str, float]:
        return {name: s for (kind, name), s in rests.items() if kind == state and s > 0}

    idle_s, scheduling_s = rests["idle", ""], rests["scheduling", ""]
    return TimeBudget(executing, of("waiting"), of("blocked"), idle_s, scheduling_s)
