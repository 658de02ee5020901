"""The dashboard's end of the control channel: it asks while somebody looks, and only then."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuros.control import connect, encode_line
from neuros.dashboard.figures import Figures
from neuros.dashboard.pages import Pages
from neuros.dashboard.pictures import data_url

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
        phase: what the supervisor has said last of where the run is.
    """

    def __init__(self, pages: Pages, names: tuple[str, ...], start_s: float) -> None:
        self._pages = pages
        self._names = set(names)
        self._figures = Figures()
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
