"""The pages that are open now, what they want to see, and what they are sent."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from typing import Any

_MOST_WAITING = 100

Wanted = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""By node and port, what is to be sampled (see :class:`neuros.runtime.sampling.Sampler`)."""


def wanted_of(asked: Any) -> Wanted:
    """What a page asks for, of its right form. Raises ``TypeError``, ``AttributeError`` if not."""
    return {
        str(node): {
            str(port): {
                "fields": [str(field) for field in each.get("fields", ())],
                "all": bool(each.get("all")),
                "image": bool(each.get("image")),
            }
            for port, each in ports.items()
        }
        for node, ports in asked.items()
    }


class Page:
    """One open page.

    Attributes:
        wanted: what it shows of packets.
    """

    def __init__(self) -> None:
        self.wanted: Wanted = {}
        self._events: asyncio.Queue[str | None] = asyncio.Queue(_MOST_WAITING)

    def send(self, event: str, data: Any) -> None:
        """Queue an event; a page that does not read loses the oldest ones."""
        self._put(f"event: {event}\ndata: {json.dumps(data)}\n\n")

    def part(self) -> None:
        """Nothing more comes."""
        self._put(None)

    async def next_event(self) -> str | None:
        """The next event, as server-sent events are written; ``None``: it was the last one."""
        return await self._events.get()

    def _put(self, item: str | None) -> None:
        if self._events.full():
            self._events.get_nowait()
        self._events.put_nowait(item)


class Pages:
    """All pages.

    Attributes:
        are_watched: set while some page is open.
    """

    def __init__(self) -> None:
        self._pages: dict[str, Page] = {}
        self._number = 0
        self.are_watched = asyncio.Event()
        self.are_gone = asyncio.Event()
        self.are_gone.set()

    def open(self) -> tuple[str, Page]:
        """A new page, and its name."""
        self._number += 1
        name, page = str(self._number), Page()
        self._pages[name] = page
        self.are_watched.set()
        self.are_gone.clear()
        return name, page

    def close(self, name: str) -> None:
        """A page is no longer there."""
        self._pages.pop(name, None)
        if not self._pages:
            self.are_watched.clear()
            self.are_gone.set()

    def want(self, name: str, wanted: Wanted) -> bool:
        """A page shows other things now; returns False if there is no such page."""
        page = self._pages.get(name)
        if page is None:
            return False
        page.wanted = wanted
        return True

    def send(self, event: str, data: Any) -> None:
        """Send to all pages."""
        for page in self._pages.values():
            page.send(event, data)

    def part(self) -> None:
        """The run is over: end all pages' streams once they have been read."""
        for page in self._pages.values():
            page.part()

    def wanted(self) -> dict[str, dict[str, dict[str, Any]]]:
        """What any page wants."""
        merged: dict[str, dict[str, dict[str, Any]]] = {}
        for page in self._pages.values():
            for node, ports in page.wanted.items():
                for port, each in ports.items():
                    into = merged.setdefault(node, {}).setdefault(port, {"fields": []})
                    into["fields"] = list(dict.fromkeys([*into["fields"], *each.get("fields", ())]))
                    for flag in ("all", "image"):
                        into[flag] = bool(into.get(flag) or each.get(flag))
        return merged
