"""Observer of a run that shows packets in a viewer."""

from __future__ import annotations

import contextlib
import select
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from neuros.control import LookAll, NodeStatus, Watch
from neuros.control.link import ControlLink
from neuros.viewers.visual_types import Mark, VisualTypes

_PERIOD_S = 0.2


def look_on(
    link: ControlLink,
    sources: Mapping[str, tuple[str, str, VisualTypes]],
    show: Callable[[str, float, Sequence[Mark]], None],
) -> None:
    """Ask for samples of packets until the run is over.

    Args:
        link: to the supervisor; closed in the end.
        sources: by name, the node and the port, and what is shown of it.
        show: called with a name, the time since the start in seconds, and what was seen.
    """
    names = {(node, port): name for name, (node, port, _) in sources.items()}
    begin_s = next_s = time.monotonic()
    with contextlib.closing(link):
        link.send(Watch())
        while True:
            now_s = time.monotonic()
            if now_s >= next_s:
                next_s = now_s + _PERIOD_S
                _ask(link, sources)
            if not select.select([link], [], [], max(0.0, next_s - now_s))[0]:
                continue
            messages = link.receive()
            if messages is None:
                return
            for message in messages:
                if not isinstance(message, NodeStatus):
                    continue
                for port, sample in message.samples.items():
                    name = names[message.node, port]
                    for row in sample.get("values", ()):
                        row[0] -= begin_s
                    show(name, now_s - begin_s, list(sources[name][2].marks(sample)))


def _ask(link: ControlLink, sources: Mapping[str, tuple[str, str, VisualTypes]]) -> None:
    wanted: dict[str, dict[str, Any]] = {}
    for node, port, source in sources.values():
        wanted.setdefault(node, {})[port] = source.wanted()
    link.send(LookAll(wanted))
