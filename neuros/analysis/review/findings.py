"""Findings on a run: the bottleneck, the gain of each discard limit, and both in sentences.

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

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neuros.analysis.review.run import Run
from neuros.engine.time_budget import TimeBudget
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
    """Gain of a run without some discard limits.

    Attributes:
        connections: those that would have none.
        up_to: how many times as fast the run would be if hooks cost what they cost; 1 is nothing.
    """

    connections: tuple[str, ...]
    up_to: float


@dataclass(frozen=True)
class Bottleneck:
    """Node or loop that limits the speed of a run.

    Attributes:
        pacing: the node whose speed counts: it owns time, or else it was held up most.
        steps: from the pacing node to the root.
        root: the node that limits the speed; ``None`` for a loop of nodes, or if not known.
        loop: the nodes that wait for each other, if the search ended in a loop.
        gains: best first; equal ones by fewest connections.
    """

    pacing: str
    steps: tuple[Step, ...]
    root: str | None
    loop: tuple[str, ...]
    gains: tuple[Gain, ...]


def find_bottleneck(
    budgets: Mapping[str, TimeBudget],
    connections: Mapping[str, Connection],
    running_s: float,
    time_owner: str | None = None,
) -> Bottleneck | None:
    """Search for what limits a run whose nodes overlap.

    Args:
        budgets: by node.
        connections: by name.
        running_s: how long the run was under way.
        time_owner: the node that owns simulated time.

    Returns:
        ``None`` if no node has reported.
    """
    if not budgets or running_s <= 0:
        return None
    pacing = time_owner if time_owner in budgets else _most_held_up(budgets)
    assert pacing is not None
    steps, loop = _follow(pacing, budgets, connections, running_s)
    root: str | None = steps[-1].node
    if steps[-1].state not in ("executing", "idle"):
        root = max(loop or (steps[-1].node,), key=lambda node: budgets[node].own_s)
        if budgets[root].own_s < running_s / 2:
            root = None
    gains = _gains(pacing, budgets, connections, running_s)
    return Bottleneck(pacing, tuple(steps), root, loop, gains)


def _most_held_up(budgets: Mapping[str, TimeBudget]) -> str:
    blocked = {node: sum(spent.blocked.values()) for node, spent in budgets.items()}
    most = max(blocked, key=lambda node: blocked[node])
    if blocked[most] > WORTH_NAMING * budgets[most].total_s:
        return most
    return max(budgets, key=lambda node: budgets[node].own_s)


def _follow(
    node: str,
    budgets: Mapping[str, TimeBudget],
    connections: Mapping[str, Connection],
    running_s: float,
) -> tuple[list[Step], tuple[str, ...]]:
    """The steps, and the loop in which they end."""
    steps: list[Step] = []
    seen: list[str] = []
    while True:
        seen.append(node)
        step = _largest(node, budgets[node], running_s)
        steps.append(step)
        following = _held_up_by(step, budgets, connections)
        if following is None:
            return steps, ()
        if following in seen:
            return steps, tuple(seen[seen.index(following) :])
        node = following


def _largest(node: str, spent: TimeBudget, running_s: float) -> Step:
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
    share_s = spent.executing_s if state == "executing" else sums[state]
    return Step(node, state, cause, spent.share(share_s))


def _held_up_by(
    step: Step, budgets: Mapping[str, TimeBudget], connections: Mapping[str, Connection]
) -> str | None:
    """The node to ask next, ``None`` where the search ends."""
    if step.state == "blocked" and step.cause in connections:
        receiver = connections[step.cause].destination_node
        return receiver if receiver in budgets else None
    if step.state == "waiting":
        senders = [
            c.source_node
            for c in connections.values()
            if (c.destination_node, c.destination_input) == (step.node, step.cause)
            and c.source_node in budgets
        ]
        # Of several senders of one input, the one with most to do is taken for the late one.
        return max(senders, key=lambda sender: budgets[sender].own_s, default=None)
    return None


def _gains(
    pacing: str,
    budgets: Mapping[str, TimeBudget],
    connections: Mapping[str, Connection],
    running_s: float,
) -> tuple[Gain, ...]:
    reached = _coupled(pacing, budgets, connections, ())
    limiting = [
        name
        for name, c in connections.items()
        if c.discard_limit is not None
        and c.source_node in reached
        and c.source_node != c.destination_node
        and budgets[c.source_node].blocked.get(name, 0.0) > WORTH_NAMING * running_s
    ]
    cuts: list[tuple[str, ...]] = [(name,) for name in limiting]
    for receiver in dict.fromkeys(connections[name].destination_node for name in limiting):
        together = tuple(
            name
            for name, c in connections.items()
            if c.discard_limit is not None
            and c.destination_node == receiver != c.source_node
            and c.source_node in budgets
        )
        if len(together) > 1:
            cuts.append(together)
    gains = [
        Gain(cut, running_s / _least_s(pacing, cut, budgets, connections, running_s))
        for cut in cuts
    ]
    return tuple(sorted(gains, key=lambda gain: (-round(gain.up_to, 2), len(gain.connections))))


def _least_s(
    pacing: str,
    cut: Sequence[str],
    budgets: Mapping[str, TimeBudget],
    connections: Mapping[str, Connection],
    running_s: float,
) -> float:
    """The least time that the same run could take with ``cut`` free of discard limits."""
    spared_s = sum(budgets[connections[n].source_node].blocked.get(n, 0.0) for n in cut)
    coupled = _coupled(pacing, budgets, connections, cut)
    slowest_s = max(budgets[node].own_s for node in coupled)
    return min(running_s, max(running_s - spared_s, slowest_s, 1e-9))


def _coupled(
    node: str,
    budgets: Mapping[str, TimeBudget],
    connections: Mapping[str, Connection],
    cut: Sequence[str],
) -> set[str]:
    """The nodes that must keep up with ``node``: behind it, by lossless connections."""
    found, new = {node} & {*budgets}, [node]
    while new:
        at = new.pop()
        for name, c in connections.items():
            to = c.destination_node
            is_tight = c.discard_limit == 0 and name not in cut
            if c.source_node == at and is_tight and to in budgets and to not in found:
                found.add(to)
                new.append(to)
    return found


_WORTH_A_TRY = 1.05
_BUSY = 0.85


@dataclass(frozen=True)
class Findings:
    """The sentences that begin a report.

    Attributes:
        headline: the bottleneck, in a sentence.
        reasons: how that is known, and how far it can be trusted.
        gains: what would be gained without discard limits, a sentence each.
        trial: a command that tests the best of them, ``None`` if there is nothing to gain.
    """

    headline: str
    reasons: tuple[str, ...] = ()
    gains: tuple[str, ...] = ()
    trial: str | None = None


def findings_of(run: Run) -> Findings:
    """Say what limits a run."""
    budgets = run.time_budgets
    if not budgets or not run.running_s:
        return Findings(
            "What limits this run cannot be told: no node has reported how it spent its time."
        )
    if run.is_one_process:
        return _one_process(run, budgets, run.running_s)
    found = find_bottleneck(budgets, run.ends, run.running_s, run.time_owner)
    assert found is not None
    reasons = [_reason(step, budgets[step.node]) for step in found.steps]
    reasons += _caveats(run, budgets, run.running_s)
    gains = [_gain(gain, run.record) for gain in found.gains]
    if not gains:
        gains = ["No discard limit holds this run up: without them it would gain nothing."]
    best = next((gain for gain in found.gains if gain.up_to >= _WORTH_A_TRY), None)
    return Findings(
        _headline(found, budgets),
        tuple(reasons),
        tuple(gains),
        None if best is None else _trial(best, run),
    )


def _headline(found: Bottleneck, budgets: Mapping[str, TimeBudget]) -> str:
    last = found.steps[-1]
    if found.root is not None and not (last.state == "idle" and not found.loop):
        hook, busy_s = budgets[found.root].busiest_hook
        if not hook:
            return "Nothing limits the speed: no hook has executed."
        share = budgets[found.root].share(busy_s)
        text = f"{found.root}.{hook} limits the speed: it executes {share:.0%} of the time"
        if found.root != found.pacing:
            own = budgets[found.pacing].shares["executing"]
            text += f", while {found.pacing}, which sets the pace, needs {own:.0%} for itself"
        return text + "."
    if last.state == "idle":
        return (
            f"The clock of {last.node} limits the speed: {last.share:.0%} of its time it does"
            " nothing but wait for its next tick. This run is as fast as it was told to be."
        )
    if found.loop:
        shares = ", ".join(f"{n} {budgets[n].shares['executing']:.0%}" for n in found.loop)
        rest = 1 - sum(budgets[n].shares["executing"] for n in found.loop)
        waits = f"{' and '.join(found.loop)} wait for each other"
        if len(found.loop) == 1:
            waits = f"{found.loop[0]} waits for its own packets"
        text = f"No single hook limits the speed: {waits}"
        text += f" (their hooks execute {shares} of the time)."
        if rest > 0:
            text += (
                f" At least {rest:.0%} of the time none of them executes: packets and"
                " acknowledgements are under way, or the processors are busy with something else."
            )
        return text
    where = "an external topic" if last.state == "waiting" else "a node that has not reported"
    return f"{where[0].upper()}{where[1:]} limits the speed: {last.node} {_doing(last)}."


def _doing(step: Step) -> str:
    if step.state == "blocked":
        return f"is blocked on {step.cause}"
    if step.state == "waiting":
        return f"waits for its input {step.cause}"
    return "waits for its clock" if step.state == "idle" else f"executes {step.cause}"


def _reason(step: Step, spent: TimeBudget) -> str:
    if step.state == "executing":
        return f"{step.node} executes {step.share:.0%} of the time, most of it in {step.cause}."
    if step.state == "idle":
        return f"{step.node} waits for its clock {step.share:.0%} of the time."
    causes = spent.blocked if step.state == "blocked" else spent.waiting
    parts = [
        f"{name} {spent.share(seconds):.0%}"
        for name, seconds in sorted(causes.items(), key=lambda item: -item[1])
        if spent.share(seconds) >= 0.005
    ]
    what = "blocked" if step.state == "blocked" else "waiting for input"
    return (
        f"{step.node} is {what} {step.share:.0%} of the time ({', '.join(parts)}), and executes"
        f" {spent.shares['executing']:.0%}."
    )


def _caveats(run: Run, budgets: Mapping[str, TimeBudget], running_s: float) -> list[str]:
    cores = (run.record.get("machine") or {}).get("cores")
    machine = (run.record.get("system_load") or {}).get("machine")
    shares = [sum(sum(s.executing.values()) for s in budgets.values()) / running_s / (cores or 1)]
    if machine:
        shares.append(machine["cpu_percent_mean"] / 100 / machine["cores"])
    if not cores or max(shares) < _BUSY:
        return []
    subject = "The processor was" if cores == 1 else f"The {cores} processors were"
    return [
        f"{subject} {min(1.0, max(shares)):.0%} busy: what a hook costs depends on what else runs,"
        " and predictions may be off either way."
    ]


def _gain(gain: Gain, record: Mapping[str, Any]) -> str:
    names = " and ".join(gain.connections)
    one = len(gain.connections) == 1
    if gain.up_to < _WORTH_A_TRY:
        return f"Without the discard limit{'' if one else 's'} of {names}: next to nothing."
    text = f"Without the discard limit{'' if one else 's'} of {names}: up to"
    text += f" {gain.up_to:.1f} times as fast"
    factor = record.get("real_time_factor")
    if factor:
        text += f" (real-time factor {factor:.2f}, then up to {factor * gain.up_to:.2f})"
    return f"{text}. Packets may then be lost there."


def _trial(gain: Gain, run: Run) -> str:
    settings = []
    for name in gain.connections:
        c = run.ends[name]
        ends = f"{c.source_node}.{c.source_output}.{c.destination_node}.{c.destination_input}"
        settings += ["--set", f"connections.{ends}.discard_limit="]
    return shlex.join(["neuros", "launch", str(run.record.get("file", "PROJECT")), *settings])


def _one_process(run: Run, budgets: Mapping[str, TimeBudget], running_s: float) -> Findings:
    """One thread runs all hooks: none overlap, so that no node holds up another."""
    node, (hook, busy_s) = max(
        ((name, spent.busiest_hook) for name, spent in budgets.items()), key=lambda x: x[1][1]
    )
    all_s = sum(spent.executing_s for spent in budgets.values())
    slowest = max(budgets, key=lambda name: budgets[name].executing_s)
    at_most = all_s / max(budgets[slowest].executing_s, 1e-9)
    idle = max(0.0, 1 - all_s / running_s)
    headline = (
        f"One thread runs all hooks in turn (in-process); {node}.{hook} takes the largest share:"
        f" {budgets[node].share(busy_s):.0%} of the time."
    )
    if idle > 0.5:
        headline = (
            f"Nothing that was computed limits the speed: {idle:.0%} of the time no hook executes."
        )
    return Findings(
        headline,
        tuple(
            f"{name} executes {spent.shares['executing']:.0%} of the time."
            for name, spent in budgets.items()
        ),
        (
            "With the process back end hooks overlap: those that cost what they cost here would"
            f" be done at most {at_most:.1f} times as fast, since {slowest} alone has that much to"
            " do. What a discard limit costs, a run in one thread does not show.",
        ),
    )
