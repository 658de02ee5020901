"""The stall explainer of one node: why nothing moves there, in sentences that begin with a verb.

Put behind the node's name they read "snn waits for `imu` from robot", and so name whole chains.
"""

from __future__ import annotations

from collections.abc import Iterator

from neuros.core.engine import Engine
from neuros.core.flow import Outlet
from neuros.core.hook import Hook, Source
from neuros.core.inputs import InputSlot
from neuros.core.ledger import steadily


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
    missing = [str(o.connection) for o in engine.outlets.values() if not o.is_registered]
    if missing:
        return [f"waits for these receivers to appear: {', '.join(missing)}"]
    if not engine.is_started:
        return ["has not been started yet"]
    if engine.is_paused:
        return ["is paused"]
    reasons = [
        reason for hook in engine.hooks() if hook.is_enabled for reason in _reasons(hook, now_ns)
    ]
    # Two hooks may be held up by the same thing; that is said once.
    return list(dict.fromkeys(reasons)) or ["has no hook that could run any more"]


def _reasons(hook: Hook, now_ns: int) -> Iterator[str]:
    if hook.is_ready():
        yield f"is about to run hook '{hook.name}'"
        return
    if isinstance(hook, Source) and not hook.is_due:
        outputs = ", ".join(f"`{output.port.name}`" for output in hook.outputs)
        yield f"waits for its simulator to send {outputs}"
        return
    for slot in hook.slots:
        if slot.missing:
            yield f"waits for `{slot.name}` from {_senders(slot)}"
    for outlet in hook.blocking_outlets():
        yield f"is blocked on `{outlet.connection}` ({_account_of(outlet, now_ns)})"
    if not hook.is_due:
        wait_ns = hook.due_ns - now_ns
        yield f"waits for the next tick of '{hook.name}' in {_seconds(wait_ns)}"


def _senders(slot: InputSlot) -> str:
    """Who could still bring what the slot lacks: any of them, or all of them."""
    names = dict.fromkeys(mailbox.inlet.source for mailbox in slot.mailboxes if not mailbox.packets)
    return (" and " if slot.is_all else " or ").join(names)


def _account_of(outlet: Outlet, now_ns: int) -> str:
    since_ns = outlet.acknowledged_ns
    if since_ns is None:
        last = "none acknowledged yet"
    else:
        last = f"last acknowledged {_seconds(now_ns - since_ns)} ago"
    return f"{outlet.outstanding} outstanding, {last}"


def _seconds(duration_ns: int) -> str:
    return f"{max(0, duration_ns) / 1e9:.1f} s"
