"""What observers see of the packets that pass a node: as few as they ask for, and none unasked.

Each observer asks again and again (:meth:`Sampler.ask`): each time it gets what was sampled for it
since, and a few packets more are looked at, on the thread that sends them, when they pass anyway.
So a node that nobody asks pays for one look at an empty table per packet, and one that is asked for
so many packets per question at most, however fast it sends.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from neuros.runtime.packet_fields import Path, all_fields, number_at, parse_path
from neuros.runtime.preview import Preview, preview

MOST_VALUES = 20
"""Packets per question of which chosen fields are read."""


class _Request:
    """What is still wanted of the packets of one port, and what was found."""

    def __init__(self, wanted: Mapping[str, Any]) -> None:
        self._names: list[str] = list(wanted.get("fields", ()))
        self._paths: list[Path] = [parse_path(name) for name in self._names]
        self._wants_all = bool(wanted.get("all"))
        self._wants_image = bool(wanted.get("image"))
        self._most = int(wanted.get("most_elements", 0))
        self._values: list[list[float | None]] = []
        self._all: dict[str, Any] | None = None
        self._image: Preview | None = None
        self._fault: str | None = None

    @property
    def is_met(self) -> bool:
        """Whether no further packet is wanted."""
        has_values = not self._paths or len(self._values) >= MOST_VALUES
        return has_values and not self._wants_all and not self._wants_image

    def look_at(self, packet: Any) -> None:
        """Take from a packet what is wanted; what cannot be taken is no fault of the node's."""
        try:
            if self._paths and len(self._values) < MOST_VALUES:
                values = [number_at(packet, path) for path in self._paths]
                self._values.append([time.monotonic(), *values])
            if self._wants_all:
                self._wants_all = False
                self._all = all_fields(packet, self._most)
            if self._wants_image:
                self._wants_image = False
                self._image = preview(packet)
        except Exception as error:  # whatever a plugin has put in there
            self._fault = f"{type(error).__name__}: {error}"

    def answer(self) -> dict[str, Any]:
        """What was found, ready for JSON; empty if no packet has passed."""
        found: dict[str, Any] = {}
        if self._values:
            found |= {"fields": self._names, "values": self._values}
        if self._all is not None:
            found["all"] = self._all
        if self._image is not None:
            found["image"] = self._image.encode()
        if self._fault is not None:
            found["fault"] = self._fault
        return found


class Sampler:
    """Looks at packets for observers.

    Attributes:
        requests: by port (an output's name, or the topic of an external input), what is wanted by
            each observer; empty as long as nobody looks.
    """

    def __init__(self) -> None:
        self.requests: dict[str, list[_Request]] = {}
        self._asked: dict[int, dict[str, _Request]] = {}

    def note(self, port: str, packet: Any) -> None:
        """A packet passes. The thread of the hooks only."""
        waiting = self.requests  # the next question, which may come meanwhile, brings another one
        requests = waiting.get(port)
        if requests is not None:
            for request in requests:
                request.look_at(packet)
            if all(request.is_met for request in requests):
                del waiting[port]

    def ask(self, wanted: Mapping[str, Mapping[str, Any]], asker: int = 0) -> dict[str, Any]:
        """What was found since the ``asker``'s last question; ``wanted`` is its next one.

        One thread only, which need not be that of the hooks.

        Of each port: ``fields``, paths like ``pose.position.x`` or ``data[3]``, read of up to
        :data:`MOST_VALUES` packets; ``all``, every field of one packet (of arrays the first
        ``most_elements``); ``image``, a small picture of one packet.
        """
        asked = self._asked.get(asker, {})
        answers = {port: answer for port, request in asked.items() if (answer := request.answer())}
        self._asked[asker] = {port: _Request(each) for port, each in wanted.items()}
        waiting: dict[str, list[_Request]] = {}
        for requests in self._asked.values():
            for port, request in requests.items():
                if not request.is_met:
                    waiting.setdefault(port, []).append(request)
        self.requests = waiting
        return answers
