"""Findings on a run: the bottleneck, the gain of each discard limit, and both in sentences.

The search begins at the node that sets the pace, and follows the causes of its delays: blocked on a
connection, to the receiver; waiting for an input, to the sender. A node without long delays is the
bottleneck, and so is one that mostly waits for its own clock. Nodes that wait for each other form a
loop; its bottleneck is the node that executes most, if it does so over half of the time.

The prediction is a bound for a run whose hooks cost as much as in this one. Without the discard
limit of a connection its sender spares the time in which that connection blocked it, and no later
event comes earlier by more than the sum of those times; nor can the pacing node be faster than the
own hooks of the nodes that lossless connections still couple to it. With too few processors the
prediction may be off either way: hooks cost more when others run more often, and less when packets
are lost.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neuros.engine.metrics import TimeBudget
from neuros.project.model import Connection
from neuros_analysis.review import ReviewedRun

WORTH_NAMING = 0.02
"""Share of the time below which a cause is noise."""

HELD_UP = 0.1
"""Share of the time above which a node counts as held up by others."""


@dataclass(frozen=True)
class Step:
    """One step of the search: a node, the state it spent most of its time in, and that share.

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
        connections: the connections without a discard limit.
        up_to: the largest factor by which the run would be faster; 1 is no gain.
    """

    connections: tuple[str, ...]
    up_to: float


@dataclass(frozen=True)
class Bottleneck:
    """Node or loop that limits the speed of a run.

    Attributes:
        pacing: the node that owns time, or else the one that was held up most.
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
    """Find the bottleneck of a run whose nodes run in parallel.

    Args:
        budgets: by node.
        connections: by name.
        running_s: wall time in which all nodes ran.
        time_owner: the node that owns simulated time.

    Returns:
        ``None`` if no node has reported.
    """
    if not budgets or running_s <= 0:
        return None
    return _Search(budgets, connections, running_s).bottleneck(time_owner)


@dataclass(frozen=True)
class _Search:
    budgets: Mapping[str, TimeBudget]
    connections: Mapping[str, Connection]
    running_s: float

    def bottleneck(self, time_owner: str | None) -> Bottleneck:
        pacing = time_owner
        if pacing is None or pacing not in self.budgets:
            blocked = {node: sum(spent.blocked.values()) for node, spent in self.budgets.items()}
            pacing = max(blocked, key=lambda node: blocked[node])
            if blocked[pacing] <= WORTH_NAMING * self.budgets[pacing].total_s:
                pacing = max(self.budgets, key=self._own_s)
        steps, loop = self._follow(pacing)
        root: str | None = steps[-1].node
        if steps[-1].state not in ("executing", "idle"):
            root = max(loop or (steps[-1].node,), key=self._own_s)
            if self._own_s(root) < self.running_s / 2:
                root = None
        return Bottleneck(pacing, tuple(steps), root, loop, self._gains(pacing))

    def _own_s(self, node: str) -> float:
        return self.budgets[node].own_s

    def _follow(self, node: str) -> tuple[list[Step], tuple[str, ...]]:
        steps: list[Step] = []
        seen: list[str] = []
        while True:
            seen.append(node)
            steps.append(self._largest(node))
            following = self._held_up_by(steps[-1])
            if following is None:
                return steps, ()
            if following in seen:
                return steps, tuple(seen[seen.index(following) :])
            node = following

    def _largest(self, node: str) -> Step:
        spent = self.budgets[node]
        blocked_s, waiting_s = sum(spent.blocked.values()), sum(spent.waiting.values())
        causes: Mapping[str, float] = {}
        if spent.idle_s > max(spent.own_s, blocked_s + waiting_s):
            state, share_s = "idle", spent.idle_s
        elif blocked_s + waiting_s < HELD_UP * self.running_s:
            state, share_s, causes = "executing", spent.executing_s, spent.executing
        elif blocked_s >= waiting_s:
            state, share_s, causes = "blocked", blocked_s, spent.blocked
        else:
            state, share_s, causes = "waiting", waiting_s, spent.waiting
        cause = max(causes, key=lambda cause: causes[cause], default="")
        return Step(node, state, cause, spent.share(share_s))

    def _held_up_by(self, step: Step) -> str | None:
        """The next node of the search, ``None`` at its end."""
        if step.state == "blocked" and step.cause in self.connections:
            receiver = self.connections[step.cause].destination_node
            return receiver if receiver in self.budgets else None
        if step.state == "waiting":
            senders = [
                c.source_node
                for c in self.connections.values()
                if (c.destination_node, c.destination_input) == (step.node, step.cause)
                and c.source_node in self.budgets
            ]
            # Of several senders of an input, the busiest one is likely to be late.
            return max(senders, key=self._own_s, default=None)
        return None

    def _gains(self, pacing: str) -> tuple[Gain, ...]:
        reached = self._coupled(pacing, ())
        limited = {
            name: c
            for name, c in self.connections.items()
            if c.discard_limit is not None
            and c.source_node in self.budgets
            and c.source_node != c.destination_node
        }
        limiting = [
            name
            for name, c in limited.items()
            if c.source_node in reached and self._blocked_s(name) > WORTH_NAMING * self.running_s
        ]
        cuts: list[tuple[str, ...]] = [(name,) for name in limiting]
        for receiver in dict.fromkeys(limited[name].destination_node for name in limiting):
            together = tuple(n for n, c in limited.items() if c.destination_node == receiver)
            if len(together) > 1:
                cuts.append(together)
        gains = []
        for cut in cuts:
            spared_s = sum(map(self._blocked_s, cut))
            slowest_s = max(map(self._own_s, self._coupled(pacing, cut)))
            least_s = min(self.running_s, max(self.running_s - spared_s, slowest_s, 1e-9))
            gains.append(Gain(cut, self.running_s / least_s))
        return tuple(sorted(gains, key=lambda gain: (-round(gain.up_to, 2), len(gain.connections))))

    def _blocked_s(self, connection: str) -> float:
        sender = self.connections[connection].source_node
        return self.budgets[sender].blocked.get(connection, 0.0)

    def _coupled(self, node: str, cut: Sequence[str]) -> set[str]:
        """``node`` and all nodes behind it along lossless connections without those of ``cut``."""
        found, new = {node}, [node]
        while new:
            at = new.pop()
            for name, c in self.connections.items():
                to = c.destination_node
                is_tight = c.discard_limit == 0 and name not in cut
                if c.source_node == at and is_tight and to in self.budgets and to not in found:
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
        reasons: the evidence, and how far it can be trusted.
        gains: the gain without discard limits, a sentence each.
        trial: a command that tests the best gain, ``None`` without one.
    """

    headline: str
    reasons: tuple[str, ...] = ()
    gains: tuple[str, ...] = ()
    trial: str | None = None


def findings_of(run: ReviewedRun) -> Findings:
    budgets = run.time_budgets
    if not budgets or not run.running_s:
        return Findings("The bottleneck is not known: no node has reported how it spent its time.")
    if run.is_one_process:
        return _one_process(run, budgets, run.running_s)
    found = find_bottleneck(budgets, run.ends, run.running_s, run.time_owner)
    assert found is not None
    reasons = [_reason(step, budgets[step.node]) for step in found.steps]
    reasons += _caveats(run, budgets, run.running_s)
    gains = [_gain(gain, run.record) for gain in found.gains]
    if not gains:
        gains = ["Discard limits do not slow this run down."]
    best = next((gain for gain in found.gains if gain.up_to >= _WORTH_A_TRY), None)
    trial = None
    if best is not None:
        ends = [run.ends[name] for name in best.connections]
        settings = (
            f"connections.{c.source_node}.{c.source_output}.{c.destination_node}"
            f".{c.destination_input}.discard_limit="
            for c in ends
        )
        options = [part for setting in settings for part in ("--set", setting)]
        file = str(run.record.get("file", "PROJECT"))
        trial = shlex.join(["neuros", "launch", file, *options])
    return Findings(
        _headline(found, budgets),
        tuple(reasons),
        tuple(gains),
        trial,
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
    if last.state == "waiting":
        return f"An external topic limits the speed: {last.node} waits for its input {last.cause}."
    return f"A node that has not reported limits the speed: {last.node} is blocked on {last.cause}."


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


def _caveats(run: ReviewedRun, budgets: Mapping[str, TimeBudget], running_s: float) -> list[str]:
    cores = (run.record.get("machine") or {}).get("cores")
    machine = (run.record.get("system_load") or {}).get("machine")
    shares = [sum(sum(s.executing.values()) for s in budgets.values()) / running_s / (cores or 1)]
    if machine:
        shares.append(machine["cpu_percent_mean"] / 100 / machine["cores"])
    if not cores or max(shares) < _BUSY:
        return []
    subject = "The processor was" if cores == 1 else f"The {cores} processors were"
    return [
        f"{subject} {min(1.0, max(shares)):.0%} busy: other programs slow hooks down, so"
        " predictions may be too high or too low."
    ]


def _gain(gain: Gain, record: Mapping[str, Any]) -> str:
    plural = "" if len(gain.connections) == 1 else "s"
    text = f"Without the discard limit{plural} of {' and '.join(gain.connections)}:"
    if gain.up_to < _WORTH_A_TRY:
        return f"{text} about as fast as now."
    text += f" up to {gain.up_to:.1f} times as fast"
    factor = record.get("real_time_factor")
    if factor:
        text += f" (real-time factor {factor:.2f}, then up to {factor * gain.up_to:.2f})"
    return f"{text}. Packets may then be lost there."


def _one_process(run: ReviewedRun, budgets: Mapping[str, TimeBudget], running_s: float) -> Findings:
    """Findings on a run in one thread, in which no node holds up another."""
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
        headline = f"No computation limits the speed: no hook executes for {idle:.0%} of the time."
    return Findings(
        headline,
        tuple(
            f"{name} executes {spent.shares['executing']:.0%} of the time."
            for name, spent in budgets.items()
        ),
        (
            f"With the process back end, hooks overlap, and the run could be up to {at_most:.1f}"
            f" times as fast; then {slowest} is the limit. A run in one thread does not show what"
            " discard limits cost.",
        ),
    )
