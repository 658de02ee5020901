"""The bottleneck of a run in sentences, with how to test what they predict."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from neuros.core.spending import Spending
from neuros.observe.review.bottleneck import Bottleneck, Gain, Step, find_bottleneck
from neuros.observe.review.run import Run

_WORTH_A_TRY = 1.05
_BUSY = 0.85


@dataclass(frozen=True)
class Findings:
    """What a report says first.

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
    spending = run.spending
    if not spending or not run.running_s:
        return Findings(
            "What limits this run cannot be told: no node has reported how it spent its time."
        )
    if run.is_in_process:
        return _in_process(run, spending, run.running_s)
    found = find_bottleneck(spending, run.ends, run.running_s, run.time_owner)
    assert found is not None
    reasons = [_reason(step, spending[step.node]) for step in found.steps]
    reasons += _caveats(run, spending, run.running_s)
    gains = [_gain(gain, run.record) for gain in found.gains]
    if not gains:
        gains = ["No discard limit holds this run up: without them it would gain nothing."]
    best = next((gain for gain in found.gains if gain.up_to >= _WORTH_A_TRY), None)
    return Findings(
        _headline(found, spending),
        tuple(reasons),
        tuple(gains),
        None if best is None else _trial(best, run),
    )


def _headline(found: Bottleneck, spending: Mapping[str, Spending]) -> str:
    last = found.steps[-1]
    if found.root is not None and not (last.state == "idle" and not found.loop):
        hook, busy_s = spending[found.root].busiest_hook
        if not hook:
            return "Nothing limits the speed: no hook has executed."
        share = spending[found.root].share(busy_s)
        text = f"{found.root}.{hook} limits the speed: it executes {share:.0%} of the time"
        if found.root != found.pacing:
            own = spending[found.pacing].shares["executing"]
            text += f", while {found.pacing}, which sets the pace, needs {own:.0%} for itself"
        return text + "."
    if last.state == "idle":
        return (
            f"The clock of {last.node} limits the speed: {last.share:.0%} of its time it does"
            " nothing but wait for its next tick. This run is as fast as it was told to be."
        )
    if found.loop:
        shares = ", ".join(f"{n} {spending[n].shares['executing']:.0%}" for n in found.loop)
        rest = 1 - sum(spending[n].shares["executing"] for n in found.loop)
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


def _reason(step: Step, spent: Spending) -> str:
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


def _caveats(run: Run, spending: Mapping[str, Spending], running_s: float) -> list[str]:
    cores = (run.record.get("machine") or {}).get("cores")
    machine = (run.record.get("system_load") or {}).get("machine")
    shares = [sum(sum(s.executing.values()) for s in spending.values()) / running_s / (cores or 1)]
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


def _in_process(run: Run, spending: Mapping[str, Spending], running_s: float) -> Findings:
    """One thread runs all hooks: nothing overlaps, so that nobody holds up anybody."""
    node, (hook, busy_s) = max(
        ((name, spent.busiest_hook) for name, spent in spending.items()), key=lambda x: x[1][1]
    )
    all_s = sum(spent.own_s for spent in spending.values())
    slowest = max(spending, key=lambda name: spending[name].own_s)
    at_most = all_s / max(spending[slowest].own_s, 1e-9)
    idle = max(0.0, 1 - all_s / running_s)
    headline = (
        f"One thread runs all hooks in turn (in-process); {node}.{hook} takes the largest share:"
        f" {spending[node].share(busy_s):.0%} of the time."
    )
    if idle > 0.5:
        headline = (
            f"Nothing that was computed limits the speed: {idle:.0%} of the time no hook executes."
        )
    return Findings(
        headline,
        tuple(
            f"{name} executes {spent.shares['executing']:.0%} of the time."
            for name, spent in spending.items()
        ),
        (
            "With the process back end hooks overlap: those that cost what they cost here would"
            f" be done at most {at_most:.1f} times as fast, since {slowest} alone has that much to"
            " do. What a discard limit costs, a run in one thread does not show.",
        ),
    )
