"""Time budget of a node: its share of executing, waiting, blocked and idle time.

That time counts from when the last node had initialised until the end was asked for (``running_s``
of ``run.json``). A node executes its hooks, waits for input, is blocked by an output, or idles
between ticks. What is missing to all of the time is scheduling: a hook may start, and its turn has
not come. In process that is where the hooks of other nodes run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


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
    initialising = {name: (hook or {}).get("initialise_s") or 0.0 for name, hook in hooks.items()}
    rest = {name: (s or 0.0) - initialising.get(name, 0.0) for name, s in executing.items()}
    return {name: s for name, s in rest.items() if s > 0}
