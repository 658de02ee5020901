"""Open pages of the dashboard: the samples they want, their events, and pictures for them."""

from __future__ import annotations

import asyncio
import base64
import json
import struct
import zlib
from array import array
from collections.abc import Mapping
from typing import Any

_MOST_WAITING = 100
_FLAGS = ("all", "image", "spikes", "frames", "contacts")

Wanted = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""By node and port, the parts to sample (see :class:`neuros.node.sampling.Sampler`)."""


def wanted_of(asked: Any) -> Wanted:
    """The samples that a page asks for, checked. Raises ``TypeError`` or ``AttributeError``."""
    return {
        str(node): {
            str(port): {
                "arrays": [str(path) for path in each.get("arrays", ())],
                **{flag: bool(each.get(flag)) for flag in _FLAGS},
            }
            for port, each in ports.items()
        }
        for node, ports in asked.items()
    }


class Page:
    """One open page.

    Attributes:
        wanted: the samples that it shows.
    """

    def __init__(self) -> None:
        self.wanted: Wanted = {}
        self._events: asyncio.Queue[str | None] = asyncio.Queue(_MOST_WAITING)

    def send(self, event: str, data: Any) -> None:
        self._put(f"event: {event}\ndata: {json.dumps(data)}\n\n")

    def end(self) -> None:
        self._put(None)

    async def next_event(self) -> str | None:
        """The next event, in the form of server-sent events; ``None`` after the last."""
        return await self._events.get()

    def _put(self, item: str | None) -> None:
        if self._events.full():
            self._events.get_nowait()
        self._events.put_nowait(item)


class Pages:
    """All pages.

    Attributes:
        are_watched, are_gone: set while some page, or none, is open.
    """

    def __init__(self) -> None:
        self._pages: dict[str, Page] = {}
        self._number = 0
        self.are_watched = asyncio.Event()
        self.are_gone = asyncio.Event()
        self.are_gone.set()

    def open(self) -> tuple[str, Page]:
        """Add a page; returns its name and the page."""
        self._number += 1
        name, page = str(self._number), Page()
        self._pages[name] = page
        self.are_watched.set()
        self.are_gone.clear()
        return name, page

    def close(self, name: str) -> None:
        self._pages.pop(name, None)
        if not self._pages:
            self.are_watched.clear()
            self.are_gone.set()

    def set_wanted(self, name: str, wanted: Wanted) -> bool:
        """Set the samples that a page shows; returns False if there is no such page."""
        page = self._pages.get(name)
        if page is None:
            return False
        page.wanted = wanted
        return True

    def send(self, event: str, data: Any) -> None:
        for page in self._pages.values():
            page.send(event, data)

    def end(self) -> None:
        for page in self._pages.values():
            page.end()

    def wanted(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Samples that any page shows."""
        merged: dict[str, dict[str, dict[str, Any]]] = {}
        for page in self._pages.values():
            for node, ports in page.wanted.items():
                for port, each in ports.items():
                    into = merged.setdefault(node, {}).setdefault(port, {})
                    both = [*into.get("arrays", ()), *each["arrays"]]
                    into["arrays"] = list(dict.fromkeys(both))
                    for flag in _FLAGS:
                        into[flag] = bool(into.get(flag) or each.get(flag))
        return merged


_MIME_TYPES = {"jpg": "image/jpeg", "jpeg": "image/jpeg", "png": "image/png"}
_GREY, _RGB, _RGBA = 0, 2, 6


def data_url(picture: Mapping[str, Any]) -> str | None:
    """The picture as a ``data:`` URL, ``None`` for an unknown compression."""
    encoding, data = picture["encoding"], base64.b64decode(picture["data"])
    if not picture["width"]:  # compressed: "jpeg", or "rgb8; jpeg compressed bgr8"
        kind = next((kind for kind in _MIME_TYPES if kind in encoding), None)
        return kind and f"data:{_MIME_TYPES[kind]};base64,{picture['data']}"
    colour, pixels = _as_png_pixels(encoding, data)
    png = _png(picture["width"], picture["height"], colour, pixels)
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def _as_png_pixels(encoding: str, data: bytes) -> tuple[int, bytes]:
    """The PNG colour type and the pixels of an image in an encoding of ROS."""
    if encoding in ("rgb8", "8UC3"):
        return _RGB, data
    if encoding == "rgba8":
        return _RGBA, data
    if encoding in ("bgr8", "bgra8"):
        size = 3 if encoding == "bgr8" else 4
        swapped = bytearray(data)
        swapped[0::size], swapped[2::size] = data[2::size], data[0::size]
        return (_RGB if size == 3 else _RGBA), bytes(swapped)
    if encoding in ("mono16", "16UC1"):
        return _GREY, _stretched(array("H", data))
    if encoding == "32FC1":
        return _GREY, _stretched(array("f", data))
    return _GREY, data


def _stretched(values: array[Any]) -> bytes:
    """Depths in grey, from the nearest to the farthest; values that are not finite are black."""
    seen = [value for value in values if value - value == 0]
    low, high = min(seen, default=0), max(seen, default=0)
    scale = 255 / (high - low) if high > low else 0.0
    return bytes(round((v - low) * scale) if v - v == 0 else 0 for v in values)


def _png(width: int, height: int, colour: int, pixels: bytes) -> bytes:
    """PNG (ISO/IEC 15948): 8 bits per channel, rows without filter."""
    row = len(pixels) // height
    lines = b"".join(b"\0" + pixels[y * row : (y + 1) * row] for y in range(height))
    header = struct.pack(">IIBBBBB", width, height, 8, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(lines, 1)), (b"IEND", b""))
    )
