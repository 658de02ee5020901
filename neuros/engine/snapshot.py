"""Metrics of a running node as plain data, and the reasons why a node does not move.

Any thread may call :func:`snapshot` and :func:`explain` while the engine runs. They read without a
lock, so figures of one snapshot can be an event apart; those of a stopped node are exact. The
sentences of :func:`explain` begin with a verb, for the node's name before them: "snn waits for
`imu` from robot". So the sentences of several nodes name a chain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from neuros.engine.connection_ends import HookInput, SendWindow, Subscription
from neuros.engine.engine import Engine
from neuros.engine.hook import Hook, Source
from neuros.engine.metrics import IDLE, Rest, State
from neuros.hooks import HookKind

_T = TypeVar("_T")

_ATTEMPTS = 10


def snapshot(engine: Engine, now_ns: int) -> dict[str, Any]:
    """The metrics of a node so far; JSON-serialisable. Any thread.

    Args:
        now_ns: the time now, on the engine's clock.

    Returns:
        ``state``: the present state, ``{"state", "cause"}``.
        ``executing``: the running hook, ``{"name", "for_s", "executions"}``, or ``None``.
        ``outgoing``: counters by connection (``a.out -> b.in``).
        ``incoming``: likewise; an external topic is ``/topic -> b.in``. ``taker`` is a hook that
        is ready to start on the oldest unread packet.
        ``hooks``: by name, executions, seconds and missed ticks; intervals of a timed hook; the
        seconds of initialise hooks.
        ``accounting``: seconds by cause; ``total`` is their sum.
    """
    hooks = tuple(engine.all_hooks)
    rest = steadily(engine.rest, IDLE)
    return {
        "state": {"state": rest.state.value, "cause": rest.cause},
        "executing": _executing(engine, now_ns),
        "outgoing": {str(each.connection): _sent(each) for each in engine.send_windows.values()},
        "incoming": {
            f"{subscription.name} -> {engine.node.name}.{subscription.input_name}"
            if subscription.is_external
            else subscription.name: _received(subscription)
            for subscription in engine.subscriptions.values()
        },
        "hooks": _hooks(hooks),
        "accounting": _accounting(engine, hooks, rest, now_ns),
    }


def steadily(read: Callable[[], _T], otherwise: _T) -> _T:
    """Read data that another thread changes: again, if a change disturbs the reading."""
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


def _sent(window: SendWindow) -> dict[str, Any]:
    acknowledged = window.acknowledged  # before `sent`, which grows: outstanding is never < 0
    sent = window.sent
    return {
        "sent": sent,
        "acknowledged": acknowledged,
        "outstanding": sent - acknowledged if window.is_reliable else 0,
        "window": window.size,
        "is_reliable": window.is_reliable,
        "is_blocked": window.is_blocked,
    }


def _received(subscription: Subscription) -> dict[str, Any]:
    consumed = subscription.consumed  # before `received`, for the same reason
    discarded = subscription.discarded
    received = subscription.received

    def taker() -> str | None:
        inputs = (q.hook_input for q in subscription.queues if q.hook_input.would_consume(q))
        return next((each.hook.name for each in inputs if each.hook.is_ready()), None)

    return {
        "received": received,
        "consumed": consumed,
        "discarded": discarded,
        "longest_discard": subscription.longest_discard,
        "unread": received - consumed - discarded,
        "acknowledged": subscription.acknowledged,
        "taker": steadily(taker, None),
    }


def _hooks(hooks: tuple[Hook, ...]) -> dict[str, dict[str, Any]]:
    metrics: dict[str, dict[str, Any]] = {}
    for hook in hooks:  # a function with two marks is two hooks of one name
        entry = metrics.setdefault(hook.name, {"executions": 0, "busy_s": 0.0, "missed_ticks": 0})
        entry["executions"] += hook.executions
        entry["busy_s"] += hook.busy_ns / 1e9
        entry["missed_ticks"] += hook.missed_ticks
        if hook.spec.kind is HookKind.INITIALISE:
            entry["initialise_s"] = entry.get("initialise_s", 0.0) + hook.busy_ns / 1e9
        if hook.ticks is not None:
            entry["ticks"] = steadily(hook.ticks.figures, None)
    return metrics


def _accounting(engine: Engine, hooks: tuple[Hook, ...], rest: Rest, now_ns: int) -> dict[str, Any]:
    nothing: dict[Rest, int] = {}
    spent = steadily(lambda: dict(engine.spent_ns), nothing)
    for hook in hooks:
        cause = Rest(State.EXECUTING, hook.name)
        spent[cause] = spent.get(cause, 0) + hook.busy_ns
    # The open rest belongs to the present state; a hook that has just ended may be ahead of it.
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


# ---------------------------------------------------------------------- stall explainer


def explain(engine: Engine, now_ns: int) -> list[str]:
    """One sentence per reason why the node does not move, at least one. Any thread.

    Args:
        now_ns: the time now, on the engine's clock.
    """
    return steadily(lambda: _explain(engine, now_ns), ["is running"])


def _explain(engine: Engine, now_ns: int) -> list[str]:
    executing = engine.executing
    if executing is not None:
        return [f"executes hook '{executing.name}' for {_seconds(now_ns - engine.since_ns)}"]
    if engine.is_stopped:
        return ["starts no further hook, since it is ending"]
    missing = [str(o.connection) for o in engine.send_windows.values() if not o.is_registered]
    if missing:
        return [f"waits for these receivers to appear: {', '.join(missing)}"]
    if not engine.is_started:
        return ["has not been started yet"]
    if engine.is_paused:
        return ["is paused"]
    reasons = [
        reason for hook in engine.hooks() if hook.is_enabled for reason in _reasons(hook, now_ns)
    ]
    if not reasons and not engine.is_active:
        return ["waits until every node of the project is ready"]
    return list(dict.fromkeys(reasons)) or ["has no hook that could run any more"]


def _reasons(hook: Hook, now_ns: int) -> Iterator[str]:
    if hook.is_ready():
        yield f"is about to run hook '{hook.name}'"
        return
    if isinstance(hook, Source) and not hook.is_due:
        outputs = ", ".join(f"`{output.port.name}`" for output in hook.outputs)
        yield f"waits for its simulator to send {outputs}"
        return
    for hook_input in hook.inputs:
        if hook_input.missing:
            yield f"waits for `{hook_input.name}` from {_senders(hook_input)}"
    for window in hook.blocking_windows():
        last = "none acknowledged yet"
        if window.acknowledged_ns is not None:
            last = f"last acknowledged {_seconds(now_ns - window.acknowledged_ns)} ago"
        yield f"is blocked on `{window.connection}` ({window.outstanding} outstanding, {last})"
    if not hook.is_due:
        wait_ns = hook.due_ns - now_ns
        yield f"waits for the next tick of '{hook.name}' in {_seconds(wait_ns)}"


def _senders(hook_input: HookInput) -> str:
    """The senders of missing packets, joined by "and" if the input needs them all, else "or"."""
    names = dict.fromkeys(
        queue.subscription.source for queue in hook_input.queues if not queue.packets
    )
    return (" and " if hook_input.is_all else " or ").join(names)


def _seconds(duration_ns: int) -> str:
    return f"{max(0, duration_ns) / 1e9:.1f} s"
