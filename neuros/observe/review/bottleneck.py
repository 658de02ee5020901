"""What limits the speed of a run, and what it would gain without a discard limit.

The search begins at the node that sets the pace and asks what holds it up. Blocked on a connection:
the receiver does, which is asked next. Waiting for an input: its sender does. A node that nothing
holds up for long is the bottleneck, and so is one that mostly waits for its own clock. Where the
search comes back to a node that it has seen, the nodes wait for each other in a loop, and the
bottleneck is the one that executes most, if it does so more than half of the time.

The prediction is a bound for a run whose hooks cost what they cost in this one. Without the discard
limit of a connection its sender loses no time any more in which that connection blocked it, and
whatever happens later in the run happens earlier by no more than the sum of that; nor is the pacing
node faster than any node that remains coupled to it by lossless connections needs for its own
hooks. Where processors are short, hooks cost more when others run more often, and less when packets
are lost that need not be worked on: then it may be off either way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from neuros.core.spending import Spending
from neuros.project.model import Connection

WORTH_NAMING = 0.02
"""Share of the time below which a cause is noise."""

HELD_UP = 0.1
"""Share of the time from which on a node counts as held up by others."""


@dataclass(frozen=True)
class Step:
    """One step of the search: a node, what took most of its time, and which share that was.

    Attributes:
        state: ``"executing"``, ``"waiting"``, ``"blocked"`` or ``"idle"``.
        cause: the hook, input or connection.
    """

    node: str
    state: str
    cause: str
    share: float


@dataclass(frozen=True)
class Gain:
    """What leaving out discard limits would bring.

    Attributes:
        connections: those that would have none.
        up_to: how many times as fast the run would be if hooks cost what they cost; 1 is nothing.
    """

    connections: tuple[str, ...]
    up_to: float


@dataclass(frozen=True)
class Bottleneck:
    """What was found.

    Attributes:
        pacing: the node whose speed counts: it owns time, or else it was held up most.
        steps: from the pacing node to the root.
        root: the node that limits the speed; ``None`` where a loop of nodes does, or nobody knows.
        loop: the nodes that wait for each other, if the search ended in a loop.
        gains: best first; equal ones by fewest connections.
    """

    pacing: str
    steps: tuple[Step, ...]
    root: str | None
    loop: tuple[str, ...]
    gains: tuple[Gain, ...]


def find_bottleneck(
    spending: Mapping[str, Spending],
    connections: Mapping[str, Connection],
    running_s: float,
    time_owner: str | None = None,
) -> Bottleneck | None:
    """Search for what limits a run whose nodes overlap.

    Args:
        spending: by node.
        connections: by name.
        running_s: how long the run was under way.
        time_owner: the node that owns simulated time.

    Returns:
        ``None`` if no node has reported.
    """
    if not spending or running_s <= 0:
        return None
    pacing = time_owner if time_owner in spending else _most_held_up(spending)
    assert pacing is not None
    steps, loop = _follow(pacing, spending, connections, running_s)
    root: str | None = steps[-1].node
    if steps[-1].state not in ("executing", "idle"):
        root = max(loop or (steps[-1].node,), key=lambda node: spending[node].own_s)
        if spending[root].own_s < running_s / 2:
            root = None
    gains = _gains(pacing, spending, connections, running_s)
    return Bottleneck(pacing, tuple(steps), root, loop, gains)


def _most_held_up(spending: Mapping[str, Spending]) -> str:
    blocked = {node: sum(spent.blocked.values()) for node, spent in spending.items()}
    most = max(blocked, key=lambda node: blocked[node])
    if blocked[most] > WORTH_NAMING * spending[most].total_s:
        return most
    return max(spending, key=lambda node: spending[node].own_s)


def _follow(
    node: str,
    spending: Mapping[str, Spending],
    connections: Mapping[str, Connection],
    running_s: float,
) -> tuple[list[Step], tuple[str, ...]]:
    """The steps, and the loop in which they end."""
    steps: list[Step] = []
    seen: list[str] = []
    while True:
        seen.append(node)
        step = _largest(node, spending[node], running_s)
        steps.append(step)
        following = _held_up_by(step, spending, connections)
        if following is None:
            return steps, ()
        if following in seen:
            return steps, tuple(seen[seen.index(following) :])
        node = following


def _largest(node: str, spent: Spending, running_s: float) -> Step:
    sums = {
        "executing": spent.own_s,
        "blocked": sum(spent.blocked.values()),
        "waiting": sum(spent.waiting.values()),
        "idle": spent.idle_s,
    }
    held_s = sums["blocked"] + sums["waiting"]
    if spent.idle_s > max(spent.own_s, held_s):
        state = "idle"
    elif held_s < HELD_UP * running_s:
        state = "executing"
    else:
        state = "blocked" if sums["blocked"] >= sums["waiting"] else "waiting"
    causes: Mapping[str, float] = {}
    if state == "executing":
        causes = spent.executing
    elif state == "blocked":
        causes = spent.blocked
    elif state == "waiting":
        causes = spent.waiting
    cause = max(causes, key=lambda cause: causes[cause], default="")
    return Step(node, state, cause, spent.share(sums[state]))


def _held_up_by(
    step: Step, spending: Mapping[str, Spending], connections: Mapping[str, Connection]
) -> str | None:
    """The node to ask next, ``None`` where the search ends."""
    if step.state == "blocked" and step.cause in connections:
        receiver = connections[step.cause].destination_node
        return receiver if receiver in spending else None
    if step.state == "waiting":
        senders = [
            c.source_node
            for c in connections.values()
            if (c.destination_node, c.destination_input) == (step.node, step.cause)
            and c.source_node in spending
        ]
        # Of several senders of one input, the one with most to do is taken for the late one.
        return max(senders, key=lambda sender: spending[sender].own_s, default=None)
    return None


def _gains(
    pacing: str,
    spending: Mapping[str, Spending],
    connections: Mapping[str, Connection],
    running_s: float,
) -> tuple[Gain, ...]:
    reached = _coupled(pacing, spending, connections, ())
    limiting = [
        name
        for name, c in connections.items()
        if c.discard_limit is not None
        and c.source_node in reached
        and c.source_node != c.destination_node
        and spending[c.source_node].blocked.get(name, 0.0) > WORTH_NAMING * running_s
    ]
    cuts: list[tuple[str, ...]] = [(name,) for name in limiting]
    for receiver in dict.fromkeys(connections[name].destination_node for name in limiting):
        together = tuple(
            name
            for name, c in connections.items()
            if c.discard_limit is not None
            and c.destination_node == receiver != c.source_node
            and c.source_node in spending
        )
        if len(together) > 1:
            cuts.append(together)
    gains = [
        Gain(cut, running_s / _least_s(pacing, cut, spending, connections, running_s))
        for cut in cuts
    ]
    return tuple(sorted(gains, key=lambda gain: (-round(gain.up_to, 2), len(gain.connections))))


def _least_s(
    pacing: str,
    cut: Sequence[str],
    spending: Mapping[str, Spending],
    connections: Mapping[str, Connection],
    running_s: float,
) -> float:
    """The least time that the same run could take with ``cut`` free of discard limits."""
    spared_s = sum(spending[connections[n].source_node].blocked.get(n, 0.0) for n in cut)
    coupled = _coupled(pacing, spending, connections, cut)
    slowest_s = max(spending[node].own_s for node in coupled)
    return min(running_s, max(running_s - spared_s, slowest_s, 1e-9))


def _coupled(
    node: str,
    spending: Mapping[str, Spending],
    connections: Mapping[str, Connection],
    cut: Sequence[str],
) -> set[str]:
    """The nodes that must keep up with ``node``: behind it, by lossless connections."""
    found, new = {node} & {*spending}, [node]
    while new:
        at = new.pop()
        for name, c in connections.items():
            to = c.destination_node
            is_tight = c.discard_limit == 0 and name not in cut
            if c.source_node == at and is_tight and to in spending and to not in found:
                found.add(to)
                new.append(to)
    return found
