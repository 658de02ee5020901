"""The books of a running node as plain data: for reports, ``run.json`` and the table at the end.

:func:`snapshot` may be called from any thread while the engine runs. It only reads, and it takes no
lock, so figures of one snapshot can be an event apart; once the node has stopped they are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from neuros.core.accounting import IDLE, Rest, State
from neuros.core.engine import Engine
from neuros.core.flow import Outlet
from neuros.core.hook import Hook
from neuros.core.inputs import Inlet
from neuros.hooks import HookKind

_T = TypeVar("_T")

_ATTEMPTS = 10


def snapshot(engine: Engine, now_ns: int) -> dict[str, Any]:
    """What a node has sent, received and done so far; JSON-serialisable. Any thread.

    Args:
        now_ns: the time now, on the engine's clock.

    Returns:
        ``state``: what it does now, ``{"state", "cause"}``.
        ``executing``: the hook that runs now, ``{"name", "for_s", "executions"}``, or ``None``.
        ``outgoing``: counters by connection (``a.out -> b.in``).
        ``incoming``: the same; an external topic is ``/topic -> b.in``. ``taker`` is a hook that
        is ready to start on the oldest unread packet.
        ``hooks``: executions, seconds and missed ticks by name; of timed ones their intervals, of
        those that initialise, how many of the seconds that took.
        ``accounting``: seconds by cause; ``total`` is the sum of all others.
    """
    hooks = tuple(engine.all_hooks)
    rest = steadily(engine.rest, IDLE)
    return {
        "state": {"state": rest.state.value, "cause": rest.cause},
        "executing": _executing(engine, now_ns),
        "outgoing": {str(o.connection): _outgoing(o) for o in engine.outlets.values()},
        "incoming": {
            f"{inlet.name} -> {engine.node.name}.{inlet.input_name}"
            if inlet.is_external
            else inlet.name: _incoming(inlet)
            for inlet in engine.inlets.values()
        },
        "hooks": _hooks(hooks),
        "accounting": _accounting(engine, hooks, rest, now_ns),
    }


def steadily(read: Callable[[], _T], otherwise: _T) -> _T:
    """Read what another thread changes meanwhile: again, if it changed under the reader's eyes."""
    for _ in range(_ATTEMPTS):
        try:
            return read()
        except (RuntimeError, LookupError, ValueError, StopIteration):
            continue
    return otherwise


def _executing(engine: Engine, now_ns: int) -> dict[str, Any] | None:
    hook = engine.executing
    if hook is None:
        return None
    return {
        "name": hook.name,
        "for_s": max(0, now_ns - engine.since_ns) / 1e9,
        "executions": hook.executions,
    }


def _outgoing(outlet: Outlet) -> dict[str, Any]:
    acknowledged = outlet.acknowledged  # before `sent`, which only grows: outstanding is never < 0
    sent = outlet.sent
    return {
        "sent": sent,
        "acknowledged": acknowledged,
        "outstanding": sent - acknowledged if outlet.is_reliable else 0,
        "window": outlet.window,
        "is_reliable": outlet.is_reliable,
        "is_blocked": outlet.is_blocked,
    }


def _incoming(inlet: Inlet) -> dict[str, Any]:
    consumed, discarded = inlet.consumed, inlet.discarded  # before `received`, for the same reason
    received = inlet.received
    return {
        "received": received,
        "consumed": consumed,
        "discarded": discarded,
        "longest_discard": inlet.longest_discard,
        "unread": received - consumed - discarded,
        "acknowledged": inlet.acknowledged,
        "taker": steadily(lambda: _taker(inlet), None),
    }


def _taker(inlet: Inlet) -> str | None:
    """A hook that could start now, and would take a packet of this inlet."""
    hooks = (each.slot.hook for each in inlet.mailboxes if each.slot.would_take(each))
    return next((hook.name for hook in hooks if hook.is_ready()), None)


def _hooks(hooks: tuple[Hook, ...]) -> dict[str, dict[str, Any]]:
    books: dict[str, dict[str, Any]] = {}
    for hook in hooks:  # a function with two marks is two hooks of one name
        entry = books.setdefault(hook.name, {"executions": 0, "busy_s": 0.0, "missed_ticks": 0})
        entry["executions"] += hook.executions
        entry["busy_s"] += hook.busy_ns / 1e9
        entry["missed_ticks"] += hook.missed_ticks
        if hook.spec.kind is HookKind.INITIALISE:
            entry["initialise_s"] = entry.get("initialise_s", 0.0) + hook.busy_ns / 1e9
        if hook.ticks is not None:
            entry["ticks"] = steadily(hook.ticks.figures, None)
    return books


def _accounting(engine: Engine, hooks: tuple[Hook, ...], rest: Rest, now_ns: int) -> dict[str, Any]:
    nothing: dict[Rest, int] = {}
    spent = steadily(lambda: dict(engine.accounts.totals_ns), nothing)
    for hook in hooks:
        cause = Rest(State.EXECUTING, hook.name)
        spent[cause] = spent.get(cause, 0) + hook.busy_ns
    # What is not booked yet is what the node does now; a hook that has just ended may be ahead.
    open_ns = max(0, now_ns - engine.created_ns - sum(spent.values()))
    spent[rest] = spent.get(rest, 0) + open_ns

    def by_cause(state: State) -> dict[str, float]:
        return {cause.cause: ns / 1e9 for cause, ns in spent.items() if cause.state is state}

    def in_all(state: State) -> float:
        return sum(ns for cause, ns in spent.items() if cause.state is state) / 1e9

    return {
        "executing": by_cause(State.EXECUTING),
        "waiting": by_cause(State.WAITING),
        "blocked": by_cause(State.BLOCKED),
        "idle": in_all(State.IDLE),
        "registering": in_all(State.REGISTERING),
        "scheduling": in_all(State.SCHEDULING),
        "paused": in_all(State.PAUSED),
        "total": sum(spent.values()) / 1e9,
    }
