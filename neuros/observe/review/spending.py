"""How the nodes spent the time in which all of them ran: without start and end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from neuros.observe.review.run import Run


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


def spending_of(run: Run) -> dict[str, Spending]:
    """By node, for those that have reported.

    The books of a node begin with it. Initialise hooks are left out; what then is longer than the
    run was under way is the wait for nodes that began later, and for the end. It is taken off what
    the node waited for longest: which it was, sums cannot tell.
    """
    return {
        name: _spending(node["accounting"], _initialisers(run, name), run.running_s)
        for name, node in run.nodes.items()
        if node.get("accounting")
    }


def _initialisers(run: Run, node: str) -> set[str]:
    trace = run.traces.get(node)
    hooks = trace.hooks if trace is not None else ()
    kinds: dict[str, set[str]] = {}
    for name, kind in hooks:
        kinds.setdefault(name, set()).add(kind)
    return {name for name, found in kinds.items() if found == {"initialise"}}


def _spending(
    accounting: Mapping[str, Any], initialisers: set[str], running_s: float | None
) -> Spending:
    hooks = accounting.get("executing", {})
    executing = {name: s for name, s in hooks.items() if name not in initialisers}
    scheduling_s = accounting.get("scheduling", 0.0)
    rests = {
        (state, name): s
        for state in ("waiting", "blocked")
        for name, s in accounting.get(state, {}).items()
    }
    rests["idle", ""] = accounting.get("idle", 0.0)
    if running_s is not None:
        surplus_s = sum(executing.values()) + scheduling_s + sum(rests.values()) - running_s
        for cause in sorted(rests, key=lambda cause: rests[cause], reverse=True):
            taken_s = min(max(surplus_s, 0.0), rests[cause])
            rests[cause] -= taken_s
            surplus_s -= taken_s

    def of(state: str) -> dict[str, float]:
        return {name: s for (kind, name), s in rests.items() if kind == state and s > 0}

    return Spending(executing, of("waiting"), of("blocked"), rests["idle", ""], scheduling_s)
