"""How nodes spent the time in which all of them ran: the same for table, report and figures.

That time counts from when the last node had initialised until the end was asked for (``running_s``
of ``run.json``). A node executes (its hooks, and the scheduling between them), waits for input, is
blocked by an output, or idles between ticks; the four shares add up to 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Spending:
    """One node's wall time while the run was under way, in seconds.

    Attributes:
        executing: by hook; waiting: by input; blocked: by connection.
        own_s: what it needs for itself: hooks and scheduling.
    """

    executing: Mapping[str, float]
    waiting: Mapping[str, float]
    blocked: Mapping[str, float]
    idle_s: float
    scheduling_s: float

    @property
    def own_s(self) -> float:
        """What nobody else could spare it."""
        return sum(self.executing.values()) + self.scheduling_s

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
        """Executing (with scheduling), waiting, blocked and idle; together 1."""
        return {
            "executing": self.share(self.own_s),
            "waiting": self.share(sum(self.waiting.values())),
            "blocked": self.share(sum(self.blocked.values())),
            "idle": self.share(self.idle_s),
        }


def spending_of(node: Mapping[str, Any], running_s: float | None) -> Spending | None:
    """How a node of ``run.json`` spent its time; ``None`` if it has not reported.

    The books of a node begin with it. Initialise hooks are left out; what then is longer than the
    run was under way is the wait for nodes that began later, and for the end. It is taken off what
    the node waited for longest: which it was, sums cannot tell.
    """
    accounting = node.get("accounting")
    if not accounting:
        return None
    executing = _without_initialising(accounting.get("executing", {}), node.get("hooks") or {})
    scheduling_s = accounting.get("scheduling", 0.0)
    rests = {
        (state, name): s
        for state in ("waiting", "blocked")
        for name, s in accounting.get(state, {}).items()
    }
    rests["idle", ""] = accounting.get("idle", 0.0)
    if running_s:
        surplus_s = sum(executing.values()) + scheduling_s + sum(rests.values()) - running_s
        for cause in sorted(rests, key=lambda cause: rests[cause], reverse=True):
            taken_s = min(max(surplus_s, 0.0), rests[cause])
            rests[cause] -= taken_s
            surplus_s -= taken_s

    def of(state: str) -> dict[str, float]:
        return {name: s for (kind, name), s in rests.items() if kind == state and s > 0}

    return Spending(executing, of("waiting"), of("blocked"), rests["idle", ""], scheduling_s)


def _without_initialising(
    executing: Mapping[str, float], hooks: Mapping[str, Mapping[str, Any]]
) -> dict[str, float]:
    """Seconds by hook without those of ``neuros_initialise``; a function may have other marks."""
    rest = {name: s - hooks.get(name, {}).get("initialise_s", 0.0) for name, s in executing.items()}
    return {name: s for name, s in rest.items() if s > 0}
