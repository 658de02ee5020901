"""What an observer is told of a node several times per second: counters, state, latest times."""

from __future__ import annotations

from typing import Any

from neuros.core.engine import Engine
from neuros.core.ledger import snapshot, steadily
from neuros.project.model import Connection

_LAST_SENT = 16


def glimpse(engine: Engine, now_ns: int) -> dict[str, Any]:
    """The books of a node, short enough to be sent often; JSON-serialisable. Any thread.

    Besides what :func:`neuros.core.ledger.snapshot` tells: ``now_s``, the time of the glimpse;
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
        str(outlet.connection): [outlet.sent, outlet.sent_ns[-_LAST_SENT:].tolist()]
        for outlet in engine.outlets.values()
        if outlet.is_reliable and outlet.sent_ns
    }


def _taken(engine: Engine) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for key, inlet in engine.inlets.items():
        count = min(len(inlet.taken), len(inlet.taken_ns))
        if isinstance(key, Connection) and count:
            found[str(key)] = [inlet.taken[count - 1], inlet.taken_ns[count - 1]]
    return found
