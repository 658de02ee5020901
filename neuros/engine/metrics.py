"""Metrics of an engine: the states that its wall time is counted by, and intervals of ticks.

Between two events nothing of a node changes, so the time between them has one cause, which is
asked for once, when the next event arrives.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
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


# ---------------------------------------------------------------------- time budget
#
# Time budget of a node: its share of executing, waiting, blocked and idle time.
#
# That time counts from when the last node had initialised until the end was asked for
# (``running_s`` of ``run.json``). A node executes its hooks, waits for input, is blocked by an
# output, or idles between ticks. What is missing to all of the time is scheduling: a hook may
# start, and its turn has not come. In process that is where the hooks of other nodes run.


@dataclass(frozen=True)
class TimeBudget:
    """One node's wall time while the run was under way, in seconds.

    Attributes:
        executing: by hook; waiting: by input; blocked: by connection.
        own_s: needed by the node itself, whatever the others do.
    """

    executing: Mapping[str, float]
    waiting: Mapping[str, float]
    blocked: Mapping[str, float]
    idle_s: float
    scheduling_s: float

    @property
    def executing_s(self) -> float:
        """All hooks together."""
        return sum(self.executing.values())

    @property
    def own_s(self) -> float:
        """Hooks and scheduling."""
        return self.executing_s + self.scheduling_s

    @property
    def busiest_hook(self) -> tuple[str, float]:
        """The hook that executes longest, and its seconds; an empty name if there is none."""
        return max(self.executing.items(), key=lambda item: item[1], default=("", 0.0))

    @property
    def total_s(self) -> float:
        """All of it."""
        rest = sum(self.waiting.values()) + sum(self.blocked.values()) + self.idle_s
        return self.own_s + rest

    def share(self, seconds: float) -> float:
        """Seconds as a share of all of it, from 0 to 1."""
        return seconds / (self.total_s or 1.0)

    @property
    def shares(self) -> dict[str, float]:
        """Executing, waiting, blocked and idle; what is missing to 1 is scheduling."""
        return {
            "executing": self.share(self.executing_s),
            "waiting": self.share(sum(self.waiting.values())),
            "blocked": self.share(sum(self.blocked.values())),
            "idle": self.share(self.idle_s),
        }


def time_budget_of(node: Mapping[str, Any], running_s: float | None) -> TimeBudget | None:
    """How a node of ``run.json`` spent its time; ``None`` if it has not reported.

    The books of a node begin with it. Initialise hooks are left out; what then is longer than the
    run was under way is the wait for nodes that began later, and for the end. It is taken off what
    the node waited for longest: which it was, sums cannot tell.
    """
    accounting = node.get("accounting")
    if not accounting:
        return None
    executing = _without_initialising(accounting.get("executing") or {}, node.get("hooks") or {})
    rests = {
        (state, name): s or 0.0
        for state in ("waiting", "blocked")
        for name, s in (accounting.get(state) or {}).items()
    }
    rests |= {(state, ""): accounting.get(state) or 0.0 for state in ("idle", "scheduling")}
    if running_s:
        surplus_s = sum(executing.values()) + sum(rests.values()) - running_s
        for cause in sorted(rests, key=lambda cause: rests[cause], reverse=True):
            taken_s = min(max(surplus_s, 0.0), rests[cause])
            rests[cause] -= taken_s
            surplus_s -= taken_s

    def of(state: str) -> dict[str, float]:
        return {name: s for (kind, name), s in rests.items() if kind == state and s > 0}

    idle_s, scheduling_s = rests["idle", ""], rests["scheduling", ""]
    return TimeBudget(executing, of("waiting"), of("blocked"), idle_s, scheduling_s)


def _without_initialising(
    executing: Mapping[str, float], hooks: Mapping[str, Mapping[str, Any]]
) -> dict[str, float]:
    """Seconds by hook without those of ``neuros_initialise``; a function may have other marks."""
    initialising = {name: hook.get("initialise_s") or 0.0 for name, hook in hooks.items()}
    rest = {name: (s or 0.0) - initialising.get(name, 0.0) for name, s in executing.items()}
    return {name: s for name, s in rest.items() if s > 0}
