"""Link of the dashboard: what open pages want to see, and the control channel that answers.

The control channel is asked only while a page is open.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import struct
import time
import zlib
from array import array
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuros.control import connect, encode_line
from neuros.viewers.dashboard.live_metrics import LiveMetrics

_MOST_WAITING = 100

Wanted = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""By node and port, what is to be sampled (see :class:`neuros.node.sampling.Sampler`)."""


def wanted_of(asked: Any) -> Wanted:
    """The samples that a page asks for, checked. Raises ``TypeError`` or ``AttributeError``."""
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
        """Forget a page."""
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
        """Samples that any page shows."""
        merged: dict[str, dict[str, dict[str, Any]]] = {}
        for page in self._pages.values():
            for node, ports in page.wanted.items():
                for port, each in ports.items():
                    into = merged.setdefault(node, {}).setdefault(port, {"fields": []})
                    into["fields"] = list(dict.fromkeys([*into["fields"], *each.get("fields", ())]))
                    for flag in ("all", "image"):
                        into[flag] = bool(into.get(flag) or each.get(flag))
        return merged


_MIME_TYPES = {"jpg": "image/jpeg", "jpeg": "image/jpeg", "png": "image/png"}
_GREY, _RGB, _RGBA = 0, 2, 6


def data_url(picture: Mapping[str, Any]) -> str | None:
    """The picture as a ``data:`` URL, ``None`` if there is no way to show it."""
    encoding, data = picture["encoding"], base64.b64decode(picture["data"])
    if not picture["width"]:  # compressed: "jpeg", or "rgb8; jpeg compressed bgr8"
        kind = next((kind for kind in _MIME_TYPES if kind in encoding), None)
        return kind and f"data:{_MIME_TYPES[kind]};base64,{picture['data']}"
    colour, pixels = _as_png_pixels(encoding, data)
    png = _png(picture["width"], picture["height"], colour, pixels)
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def _as_png_pixels(encoding: str, data: bytes) -> tuple[int, bytes]:
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
    """Depths in grey, from the nearest to the farthest; what is not finite is black."""
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
        _chunk(kind, data)
        for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(lines, 1)), (b"IEND", b""))
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


_LONGEST_LINE_BYTES = 1 << 24
_PERIOD_S = 0.2
_PER_NODE_S = 0.0125
_PATIENCE_S = 1.0


class Link:
    """Between the pages and the supervisor.

    Args:
        names: the nodes of the run.
        start_s: monotonic time from which the pages count.

    Attributes:
        phase: the latest message of the supervisor about the state of the run.
    """

    def __init__(self, pages: Pages, names: tuple[str, ...], start_s: float) -> None:
        self._pages = pages
        self._names = set(names)
        self._figures = LiveMetrics()
        self._answered: set[str] = set()
        self._has_answered = asyncio.Event()
        self._writer: asyncio.StreamWriter | None = None
        self._start_s = start_s
        self.phase: dict[str, Any] = {"phase": "running", "is_paused": False}

    async def run(self, run_folder: Path) -> None:
        """Until the run is over. Raises ``OSError`` where no supervisor listens."""
        lines = connect(run_folder)
        lines.socket.setblocking(False)
        reader, self._writer = await asyncio.open_connection(
            sock=lines.socket, limit=_LONGEST_LINE_BYTES
        )
        self.tell("watch")
        asking = asyncio.create_task(self._ask())
        try:
            while line := await reader.readline():
                self._take(json.loads(line))
        except ConnectionError:
            pass
        finally:
            asking.cancel()
            self._writer.close()

    def tell(self, kind: str, **fields: Any) -> None:
        """Send to the supervisor."""
        if self._writer is not None and not self._writer.is_closing():
            self._writer.write(encode_line(kind, fields))

    async def _ask(self) -> None:
        period_s = max(_PERIOD_S, _PER_NODE_S * len(self._names))
        while True:
            await self._pages.are_watched.wait()
            self._answered.clear()
            self._has_answered.clear()
            asked_s = time.monotonic()
            self.tell("look", wanted=self._pages.wanted())
            # A node whose hook holds Python's global lock answers late: the others need not wait.
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._has_answered.wait(), _PATIENCE_S)
            self._show()
            await asyncio.sleep(max(0.0, asked_s + period_s - time.monotonic()))

    def _take(self, message: Mapping[str, Any]) -> None:
        kind = message["kind"]
        if kind == "node_status":
            self._figures.take(message)
            self._show_samples(message["node"], message["samples"])
            self._answered.add(message["node"])
            if self._answered >= self._names:
                self._has_answered.set()
        elif kind == "phase":
            self.phase = {"phase": message["phase"], "is_paused": message["is_paused"]}
            self._pages.send("phase", self.phase)
        elif kind == "log":
            self._pages.send("log", [f"[{message['severity']}] [neuros] {message['text']}"])
        elif kind == "ended":
            self._figures.end(message["reports"], message["running_s"])
            self._show()
            self.phase = {
                "phase": "ended",
                "is_paused": False,
                "exit_code": message["exit_code"],
                "reason": message["reason"],
            }
            self._pages.send("phase", self.phase)

    def _show(self) -> None:
        figures = self._figures
        self._pages.send(
            "figures",
            {
                "t": time.monotonic() - self._start_s,
                "nodes": figures.nodes,
                "connections": figures.connections,
                "sim_time": figures.sim_time,
                "real_time_factor": figures.real_time_factor,
            },
        )

    def _show_samples(self, node: str, samples: Mapping[str, dict[str, Any]]) -> None:
        shown = {}
        for port, sample in samples.items():
            for row in sample.get("values", ()):
                row[0] -= self._start_s
            if "image" in sample:
                sample["image"] = {
                    "url": data_url(sample["image"]),
                    "of": sample["image"]["of"],
                    "encoding": sample["image"]["encoding"],
                }
            shown[f"{node}.{port}"] = sample
        if shown:
            self._pages.send("samples", shown)
