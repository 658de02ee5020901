"""The drawing process of a figure: reads what hooks send on its standard input, until they end."""

from __future__ import annotations

import os
import pickle
import select
import signal
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from neuros.visualise.canvas import Canvas
from neuros.visualise.panels import PANELS, Panel

_REDRAW_S = 0.2
_HEED_S = 0.05
_READ_BYTES = 1 << 20
_LENGTH = struct.Struct("!I")


class Messages:
    """What comes in through a file descriptor, in pieces of any size."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._data = bytearray()
        self.is_over = False

    def wait(self, timeout_s: float) -> None:
        """Until something can be read."""
        select.select([self._descriptor], [], [], timeout_s)

    def read(self) -> Iterator[tuple[Any, ...]]:
        """All that is complete after one read; the other end is NeuROS in a node's process."""
        data = os.read(self._descriptor, _READ_BYTES)
        self.is_over = not data
        self._data += data
        while len(self._data) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._data)
            if len(self._data) < _LENGTH.size + length:
                return
            yield pickle.loads(self._data[_LENGTH.size : _LENGTH.size + length])
            del self._data[: _LENGTH.size + length]


class Drawing:
    """A figure and what it shows.

    Args:
        title, file, save_every_s: of the first message.
    """

    def __init__(self, title: str, file: str, save_every_s: float) -> None:
        self._canvas = Canvas(title, os.environ)
        if self._canvas.remark:
            print(f"{title}: {self._canvas.remark}", file=sys.stderr, flush=True)
        self._file = Path(file)
        self._title = title
        self._panels: list[Panel] = []
        self._faults: set[str] = set()
        self._is_new = False
        self._save_every_s = save_every_s
        self._next_draw_s = time.monotonic()
        self._next_save_s = self._next_draw_s + save_every_s

    def take(self, kind: str, number: int, *values: Any) -> None:
        """Keep what a message says."""
        self._is_new = True
        if kind == "panel":
            self._panels.append(PANELS[values[0]](values[1]))
        elif kind == "series":
            self._panels[number].add_series(*values)
        elif kind == "caption":
            self._panels[number].caption = values[0]
        else:
            self._panels[number].add_data(*values)

    def look(self) -> float:
        """Draw and save if it is time; returns for how many seconds there is nothing to do."""
        now_s = time.monotonic()
        is_saved_now = now_s >= self._next_save_s
        if self._is_new and (
            is_saved_now or (self._canvas.is_window and now_s >= self._next_draw_s)
        ):
            self._draw()
            self._is_new = False
            # What takes long is not done all the time.
            took_s = time.monotonic() - now_s
            self._next_draw_s = time.monotonic() + max(_REDRAW_S, took_s)
            if is_saved_now:
                self._save()
                self._next_save_s = time.monotonic() + self._save_every_s
        self._canvas.heed_user()
        return _HEED_S if self._canvas.is_window else self._save_every_s

    def finish(self) -> None:
        """Save what there is."""
        self._draw()
        self._save()

    def _draw(self) -> None:
        try:
            for fault in self._canvas.draw(self._panels):
                self._complain(fault)
        except Exception as error:  # of Matplotlib, about a text that a plugin has given
            self._complain(f"it cannot be drawn: {error}")

    def _save(self) -> None:
        try:
            self._canvas.save(self._file)
        except Exception as error:  # there may be room for it, or something else to draw, later
            self._complain(f"{self._file} cannot be saved: {error}")

    def _complain(self, text: str) -> None:
        """Say it once: the figure is drawn again and again."""
        if text not in self._faults:
            self._faults.add(text)
            print(f"{self._title}: {text}", file=sys.stderr, flush=True)


def main() -> None:
    """Draw until the node has gone, and save."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # it ends with its node, which is told
    messages = Messages(0)
    drawing: Drawing | None = None
    pause_s = _HEED_S
    while not messages.is_over:
        messages.wait(pause_s)
        if select.select([0], [], [], 0.0)[0]:
            for message in messages.read():
                if message[0] == "figure":
                    drawing = Drawing(*message[1:])
                elif drawing is not None:
                    drawing.take(*message)
        if drawing is not None:
            pause_s = drawing.look()
    if drawing is not None:
        drawing.finish()


if __name__ == "__main__":
    main()
