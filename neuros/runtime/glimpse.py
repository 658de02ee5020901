"""What an onlooker is told of a node several times per second: counters, state, latest times."""

from __future__ import annotations

from typing import Any

from neuros.core.engine import Engine
from neuros.core.snapshot import snapshot, steadily
from neuros.project.model import Connection

_LAST_SENT = 16


def glimpse(engine: Engine, now_ns: int) -> dict[str, Any]:
    """The books of a node, short enough to be sent often; JSON-serialisable. Any thread.

    Besides what :func:`neuros.core.snapshot.snapshot` tells: ``now_s``, the time of the glimpse;
    ``sent_ns``, by connection the position of the last packet sent and when the last few were;
    ``taken_ns``, the position of the packet that a hook has started on last, and when that was.
    Both are missing where the node's books have just been written out.
    """
    books = snapshot(engine, now_ns)
    nothing: dict[str, list[Any]] = {}
    books["hooks"] = {
        name: [hook["executions"], hook["busy_s"]] for name, hook in books["hooks"].items()
    }
    return {
        **books,
        "now_s": now_ns / 1e9,
        "sent_ns": steadily(lambda: _sent(engine), nothing),
        "taken_ns": steadily(lambda: _taken(engine), nothing),
        "is_paused": engine.is_paused,
    }


def _sent(engine: Engine) -> dict[str, list[Any]]:
    return {
        str(window.connection): [window.sent, window.sent_ns[-_LAST_SENT:].tolist()]
        for window in engine.send_windows.values()
        if window.is_reliable and window.sent_ns
    }


def _taken(engine: Engine) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for key, subscription in engine.subscriptions.items():
        count = min(len(subscription.taken), len(subscription.taken_ns))
        if isinstance(key, Connection) and count:
            found[str(key)] = [subscription.taken[count - 1], subscription.taken_ns[count - 1]]
    return found
