"""The stall explainer of one node: one sentence for each reason why no hook starts.

Each begins with a verb. Put behind the node's name they read "snn waits for `imu` from robot", and
so name whole chains.
"""

from __future__ import annotations

from collections.abc import Iterator

from neuros.engine.engine import Engine
from neuros.engine.hook import Hook, Source
from neuros.engine.input_queue import HookInput
from neuros.engine.send_window import SendWindow
from neuros.engine.snapshot import steadily


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
    # Two hooks may have one reason; that is said once.
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
        yield f"is blocked on `{window.connection}` ({_outstanding(window, now_ns)})"
    if not hook.is_due:
        wait_ns = hook.due_ns - now_ns
        yield f"waits for the next tick of '{hook.name}' in {_seconds(wait_ns)}"


def _senders(hook_input: HookInput) -> str:
    """The senders of what the input lacks, joined by "or", or by "and" if it needs them all."""
    names = dict.fromkeys(
        queue.subscription.source for queue in hook_input.queues if not queue.packets
    )
    return (" and " if hook_input.is_all else " or ").join(names)


def _outstanding(window: SendWindow, now_ns: int) -> str:
    since_ns = window.acknowledged_ns
    if since_ns is None:
        last = "none acknowledged yet"
    else:
        last = f"last acknowledged {_seconds(now_ns - since_ns)} ago"
    return f"{window.outstanding} outstanding, {last}"


def _seconds(duration_ns: int) -> str:
    return f"{max(0, duration_ns) / 1e9:.1f} s"
