"""Reads a dashboard as its page does: the stream of events, arrays that are drawn, worlds."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Iterable, Iterator
from http.cookiejar import CookieJar
from typing import Any
from urllib.parse import urljoin
from urllib.request import HTTPCookieProcessor, OpenerDirector, build_opener

from neuros.control import WORLD

_TIMEOUT_S = 30.0

Drawn = dict[str, dict[str, list[str]]]
"""By node and output, the arrays; for the output ``#world`` the node's world in 3-D."""


class Viewer:
    """One open page.

    Attributes:
        counts: how often each event has come.
    """

    def __init__(self, address: str, drawn: Drawn) -> None:
        self.counts: dict[str, int] = {}
        self._address = address
        self._drawn = drawn

    def look(self) -> None:
        """Until the run is over."""
        browser = build_opener(HTTPCookieProcessor(CookieJar()))
        browser.open(self._address, timeout=_TIMEOUT_S).close()
        with browser.open(urljoin(self._address, "/events"), timeout=_TIMEOUT_S) as stream:
            for name, data in events_of(line.decode() for line in stream):
                self.counts[name] = self.counts.get(name, 0) + 1
                if name == "begin":
                    self._want(browser, data["page"])

    def _want(self, browser: OpenerDirector, page: str) -> None:
        wanted = {
            node: {
                port: {"arrays": arrays, "frames": port == WORLD} for port, arrays in ports.items()
            }
            for node, ports in self._drawn.items()
        }
        body = json.dumps({"page": page, "wanted": wanted}).encode()
        browser.open(urljoin(self._address, "/want"), body, _TIMEOUT_S).close()


def events_of(lines: Iterable[str]) -> Iterator[tuple[str, Any]]:
    """Server-sent events, by name: a line with the name, and one with the data."""
    name = ""
    for line in lines:
        key, _, value = line.rstrip("\n").partition(": ")
        if key == "event":
            name = value
        elif key == "data":
            yield name, json.loads(value)


@contextlib.contextmanager
def viewing(address: str, drawn: Drawn) -> Iterator[Viewer]:
    """Somebody looks, until the run is over; leaving the block waits for that."""
    viewer = Viewer(address, drawn)
    thread = threading.Thread(target=viewer.look, daemon=True)
    thread.start()
    try:
        yield viewer
    finally:
        thread.join(_TIMEOUT_S)
