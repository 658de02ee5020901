"""Drawing process of a figure: reads messages of hooks from its standard input, and draws."""

from __future__ import annotations

import os
import pickle
import select
import signal
import struct
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from neuros.visualise.panels import PANELS, Panel

_TOOLKITS = ("QtAgg", "TkAgg", "macosx")
_WIDTH_INCHES, _PANEL_INCHES = 9.0, 2.6
_NO_WINDOW = "the figure has no window and is saved only: "
_NO_DISPLAY = _NO_WINDOW + "NEUROS_GUI is set, but there is no display"
_NO_TOOLKIT = _NO_WINDOW + (
    "this Python has no toolkit for one (apt install python3-tk, or PySide6 in the environment)"
)


class Canvas:
    """Matplotlib figure with panels one below the other: in a window if possible, else in memory.

    Attributes:
        is_window: whether there is one; its user may close it.
        remark: why there is no window, empty if there is nothing to say.
    """

    def __init__(self, title: str, environ: Mapping[str, str]) -> None:
        self._title = title
        self._figure, self.is_window, self.remark = _figure(title, environ)
        self._figure.canvas.mpl_connect("close_event", self._on_closed)

    def draw(self, panels: Sequence[Panel]) -> list[str]:
        """Draw all of them; returns a sentence for each that cannot be drawn."""
        faults = []
        self._figure.clear()
        if not self.is_window:
            self._figure.set_size_inches(_WIDTH_INCHES, max(2, len(panels)) * _PANEL_INCHES)
        self._figure.suptitle(self._title)
        rows = self._figure.add_gridspec(max(1, len(panels)), 1)
        end_s = max((panel.end_s for panel in panels), default=0.0)
        for row, panel in enumerate(panels):
            places = rows[row].subgridspec(1, len(panel.columns), width_ratios=panel.columns)
            axes = [
                self._figure.add_subplot(places[column], projection=projection)
                for column, projection in enumerate(panel.projections)
            ]
            try:
                panel.draw(axes, end_s)
            except Exception as error:  # of Matplotlib, about data that a plugin has given
                faults.append(f"'{panel.title}' cannot be drawn: {error}")
                for each in axes:
                    each.clear()
                axes[0].set_title(f"{panel.title}: cannot be drawn", loc="left", fontsize="small")
        self._figure.canvas.draw()
        return faults

    def save(self, path: Path) -> None:
        """Replace the file by what was drawn last; it is never half written."""
        new = path.with_suffix(".new.png")
        self._figure.savefig(new, dpi=100)
        os.replace(new, path)

    def heed_user(self) -> None:
        """Let the window react to clicks."""
        if self.is_window:
            self._figure.canvas.flush_events()

    def _on_closed(self, _: Any) -> None:
        """The user has closed the window: go on without."""
        if self.is_window:
            self.is_window = False
            FigureCanvasAgg(self._figure)


def _figure(title: str, environ: Mapping[str, str]) -> tuple[Any, bool, str]:
    """A figure, whether it is a window, and a remark."""
    wish, remark = environ.get("NEUROS_GUI", ""), ""
    if wish != "0" and _has_display(environ):
        window = _window(title)
        if window is not None:
            return window, True, ""
        remark = _NO_TOOLKIT
    elif wish not in ("", "0"):
        remark = _NO_DISPLAY
    figure = Figure(layout="constrained")
    FigureCanvasAgg(figure)
    return figure, False, remark


def _window(title: str) -> Any:
    from matplotlib import pyplot

    for toolkit in _TOOLKITS:
        try:
            pyplot.switch_backend(toolkit)
            figure = pyplot.figure(title, layout="constrained")
            figure.set_size_inches(_WIDTH_INCHES, 2 * _PANEL_INCHES)
        except Exception:  # ImportError, or the toolkit's own error when the display refuses
            continue
        pyplot.show(block=False)
        return figure
    return None


def _has_display(environ: Mapping[str, str]) -> bool:
    has = environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY")
    return bool(has) or sys.platform == "darwin"


_REDRAW_S = 0.2
_HEED_S = 0.05
_READ_BYTES = 1 << 20
_LENGTH = struct.Struct("!I")


class Messages:
    """Messages from a file descriptor, in pieces of any size."""

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
    """A figure, its panels, and when they are drawn.

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
