"""The drawing process of a figure: receives messages of hooks on standard input, and draws."""

from __future__ import annotations

import math
import os
import pickle
import select
import signal
import struct
import sys
import time
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

_MOST_POINTS = 20_000
_RING_COLUMNS = 600
_GREY, _ALPHA = "0.6", 0.9


class Series:
    """Values over time: the last ``duration_s`` seconds, or all.

    Of very many values every other one is dropped; where time goes back, the values after it are.
    """

    def __init__(self, duration_s: float | None) -> None:
        self._duration_s = duration_s
        self.times: list[float] = []
        self.values: list[Any] = []

    def add(self, time_s: float, value: Any) -> None:
        if not math.isfinite(time_s):
            return
        if self.times and time_s < self.times[-1]:  # a simulator was reset
            kept = bisect_right(self.times, time_s)
            del self.times[kept:], self.values[kept:]
        self.times.append(time_s)
        self.values.append(value)
        if len(self.times) > _MOST_POINTS:
            if self._duration_s is not None:
                start_s = max(self.times) - self._duration_s
                pairs = zip(self.times, self.values, strict=True)
                kept_pairs = [pair for pair in pairs if pair[0] >= start_s]
                if len(kept_pairs) < _MOST_POINTS * 3 // 4:
                    self.times, self.values = map(list, zip(*kept_pairs, strict=True))
                    return
            del self.times[1::2], self.values[1::2]

    def shown(self, end_s: float) -> tuple[Array, list[Any]]:
        """Times and values of the shown seconds before ``end_s``."""
        times = np.array(self.times)
        if self._duration_s is None or not times.size:
            return times, self.values
        is_shown = times >= end_s - self._duration_s
        return times[is_shown], [v for v, shown in zip(self.values, is_shown, strict=True) if shown]


class Panel:
    """One part of a figure; ``caption`` is a line above it."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        self.caption = ""
        self.title = str(options["title"])
        self.duration_s: float | None = options["duration"]
        self.y_label = str(options.get("y_label", ""))
        self.series: dict[str, Series] = {}
        self.options: dict[str, Mapping[str, Any]] = {}

    @property
    def columns(self) -> Sequence[float]:
        """The widths of its axes, side by side."""
        return [1.0]

    @property
    def projections(self) -> Sequence[str | None]:
        return [None] * len(self.columns)

    @property
    def end_s(self) -> float:
        ends = [max(series.times) for series in self.series.values() if series.times]
        return max(ends, default=0.0)

    def add_series(self, name: str, options: Mapping[str, Any]) -> None:
        self.series[name] = Series(self.duration_s)
        self.options[name] = options

    def add_data(self, name: str, time_s: Any, value: Any) -> None:
        self.series[name].add(time_s, value)

    def draw(self, axes: Sequence[Any], end_s: float) -> None:
        """Draw everything anew, up to ``end_s``, the common end of all parts of the figure."""
        self._draw(axes, end_s)
        axes[0].set_title(self.caption, loc="left", fontsize="small")

    def _draw(self, axes: Sequence[Any], end_s: float) -> None:
        raise NotImplementedError

    def _time_axis(self, axes: Any, end_s: float) -> None:
        starts = [series.times[0] for series in self.series.values() if series.times]
        start_s = min(starts, default=0.0)
        if self.duration_s is not None:
            start_s = max(start_s, end_s - self.duration_s)
        axes.set_xlim(start_s, max(end_s, start_s + 1e-3))
        axes.set_xlabel("time (s)")

    def _colour(self, name: str) -> Any:
        return self.options[name]["colour"] or f"C{list(self.series).index(name)}"


class LinesPanel(Panel):
    """Numbers over time."""

    def _draw(self, axes: Sequence[Any], end_s: float) -> None:
        (only,) = axes
        for name, series in self.series.items():
            times, values = series.shown(end_s)
            times, numbers = self._prepared(times, np.array(values, np.float64))
            style = self.options[name].get("style", "-")
            only.plot(times, numbers, style, color=self._colour(name), label=name, alpha=_ALPHA)
        self._time_axis(only, end_s)
        only.set_ylabel(self.y_label)
        only.grid(alpha=0.3)
        if self.series:
            only.legend(
                loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, frameon=False,
                fontsize="small", borderaxespad=0.1,
            )  # fmt: skip

    def _prepared(self, times: Array, values: Array) -> tuple[Array, Array]:
        return times, values


class AnglesPanel(LinesPanel):
    """Angles over time, in radians."""

    def _draw(self, axes: Sequence[Any], end_s: float) -> None:
        super()._draw(axes, end_s)
        axes[0].set_ylabel("angle (rad)")
        axes[0].set_ylim(-math.pi * 1.03, math.pi * 1.03)
        quarters = [-math.pi, -math.pi / 2, 0.0, math.pi / 2, math.pi]
        axes[0].set_yticks(quarters, [r"$-\pi$", "", "0", "", r"$\pi$"])

    def _prepared(self, times: Array, values: Array) -> tuple[Array, Array]:
        return _broken_at_wraps(times, values)


class ImagesPanel(Panel):
    """The latest image of each name."""

    @property
    def columns(self) -> Sequence[float]:
        return [1.0] * max(1, len(self.series))

    def add_data(self, name: str, time_s: Any, value: Any) -> None:
        self.series[name].times[:] = [] if time_s is None else [time_s]
        self.series[name].values[:] = [value]

    def _draw(self, axes: Sequence[Any], end_s: float) -> None:
        for place, (name, series) in zip(axes, self.series.items(), strict=True):
            place.set_axis_off()
            for image in series.values:
                top = 255 if image.dtype == np.uint8 else None
                place.imshow(image, cmap="gray", vmin=0, vmax=top)
            when = f" {series.times[0]:.2f} s" if series.times else ""
            place.set_title(f"{name}{when}", fontsize="small")

    def draw(self, axes: Sequence[Any], end_s: float) -> None:
        self._draw(axes, end_s)  # its titles are the names of images


class SpikesPanel(Panel):
    """A raster of spikes."""

    def _draw(self, axes: Sequence[Any], end_s: float) -> None:
        (only,) = axes
        lowest, middles = 0, []
        for name, series in self.series.items():
            size = self.options[name]["size"]
            start_s = -math.inf if self.duration_s is None else end_s - self.duration_s
            times = np.concatenate([np.empty(0), *(when for when, _ in series.values)])
            which = np.concatenate([np.empty(0), *(who for _, who in series.values)])
            shown = times >= start_s
            only.plot(
                times[shown], which[shown] + lowest, "|", color=self._colour(name), markersize=2.5
            )
            middles.append((lowest + size / 2, f"{name}\n({size})"))
            lowest += size
            only.axhline(lowest - 0.5, color=_GREY, linewidth=0.5)
        self._time_axis(only, end_s)
        only.set_ylim(-1, max(lowest, 1))
        only.set_yticks([y for y, _ in middles], [text for _, text in middles])

    def add_data(self, name: str, time_s: Any, value: Any) -> None:
        if time_s.size:
            self.series[name].add(float(time_s.max()), (time_s, value))


class RingPanel(Panel):
    """Activity around the circle, and over time."""

    @property
    def columns(self) -> Sequence[float]:
        return [1.0, *(2.5 for _ in self.series)]

    @property
    def projections(self) -> Sequence[str | None]:
        return ["polar", *(None for _ in self.series)]

    def _draw(self, axes: Sequence[Any], end_s: float) -> None:
        circle, *histories = axes
        circle.set_yticklabels([])
        circle.tick_params(labelsize="small")
        for name, history in zip(self.series, histories, strict=True):
            times, values = self.series[name].shown(end_s)
            history.set_title(name, fontsize="small", color=self._colour(name))
            if len(values):
                activity = values[-1]
                phases = 2.0 * np.pi * (np.arange(activity.size + 1) + 0.5) / activity.size
                circle.plot(phases, np.append(activity, activity[0]), color=self._colour(name))
                direction = _population_vector(activity)
                if direction is not None:
                    circle.plot([direction, direction], [0.0, activity.max()], "--", color="0.2")
                self._draw_history(history, times, np.array(values))
            self._time_axis(history, end_s)

    def _draw_history(self, history: Any, times: Array, values: Array) -> None:
        """Draw activity by direction and time; each column is that of the nearest time."""
        grid = np.linspace(times[0], times[-1], min(_RING_COLUMNS, max(2, times.size)))
        nearest = np.clip(np.searchsorted(times, grid), 0, times.size - 1)
        half = values.shape[1] // 2
        rolled = np.roll(values[nearest], half, axis=1).T  # from -pi to pi
        extent = (times[0], max(times[-1], times[0] + 1e-3), -math.pi, math.pi)
        history.imshow(rolled, aspect="auto", origin="lower", extent=extent, interpolation="none")
        directions = [_population_vector(column) for column in values[nearest]]
        decoded = np.array([math.nan if d is None else d for d in directions])
        history.plot(*_broken_at_wraps(grid, decoded), color="w", linewidth=1)
        history.set_ylim(-math.pi, math.pi)
        history.set_yticks([-math.pi, 0.0, math.pi], [r"$-\pi$", "0", r"$\pi$"])


def _broken_at_wraps(time_s: Array, angle_rad: Array) -> tuple[Array, Array]:
    """Both series with a NaN where a line from one angle to the next would cross the figure."""
    jumps = np.flatnonzero(np.abs(np.diff(angle_rad)) > math.pi) + 1
    return np.insert(time_s, jumps, np.nan), np.insert(angle_rad, jumps, np.nan)


def _population_vector(activity: Array) -> float | None:
    """The direction of a ring of neurons, in radians; ``None`` if the ring is silent.

    Neuron ``i`` of ``n`` prefers ``2 pi (i + 1/2) / n``; the direction is that of the sum of these
    unit vectors, weighted by activity (Georgopoulos, Schwartz & Kettner, Science 233, 1416, 1986).
    """
    phases = 2.0 * np.pi * (np.arange(activity.size) + 0.5) / max(activity.size, 1)
    total = complex(np.sum(activity * np.exp(1j * phases)))
    return None if abs(total) < 1e-12 else math.atan2(total.imag, total.real)


PANELS = {
    "lines": LinesPanel,
    "angles": AnglesPanel,
    "images": ImagesPanel,
    "spikes": SpikesPanel,
    "ring": RingPanel,
}


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
        is_window: whether there is a window; its user may close it.
        remark: why there is no window; may be empty.
    """

    def __init__(self, title: str, environ: Mapping[str, str]) -> None:
        self._title, self.remark = title, ""
        wish, window = environ.get("NEUROS_GUI", ""), None
        if wish != "0" and _has_display(environ):
            window = _window(title)
            self.remark = _NO_TOOLKIT if window is None else ""
        elif wish not in ("", "0"):
            self.remark = _NO_DISPLAY
        self.is_window = window is not None
        self._figure: Any = window or Figure(layout="constrained")
        if not self.is_window:
            FigureCanvasAgg(self._figure)
        self._figure.canvas.mpl_connect("close_event", self._on_closed)

    def draw(self, panels: Sequence[Panel]) -> list[str]:
        """Draw all panels; returns a sentence for each that cannot be drawn."""
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
            except Exception as error:  # of Matplotlib, about a plugin's data
                faults.append(f"'{panel.title}' cannot be drawn: {error}")
                for each in axes:
                    each.clear()
                axes[0].set_title(f"{panel.title}: cannot be drawn", loc="left", fontsize="small")
        self._figure.canvas.draw()
        return faults

    def save(self, path: Path) -> None:
        """Replace the file by the last drawing, atomically."""
        new = path.with_suffix(".new.png")
        self._figure.savefig(new, dpi=100)
        os.replace(new, path)

    def process_events(self) -> None:
        """Let the window react to its user."""
        if self.is_window:
            self._figure.canvas.flush_events()

    def _on_closed(self, _: Any) -> None:
        """Go on without the window that the user has closed."""
        if self.is_window:
            self.is_window = False
            FigureCanvasAgg(self._figure)


def _window(title: str) -> Any:
    """A figure in a window; ``None`` without a toolkit."""
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
_EVENTS_S = 0.05
_READ_BYTES = 1 << 20
_LENGTH = struct.Struct("!I")


class MessageReader:
    """Splits the data of a file descriptor into messages."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._data = bytearray()
        self.is_over = False

    def wait(self, timeout_s: float) -> bool:
        """Whether data can be read, now or within the timeout."""
        return bool(select.select([self._descriptor], [], [], timeout_s)[0])

    def read(self) -> Iterator[tuple[Any, ...]]:
        """The messages that are complete after one read; only the node's process writes them."""
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
    """A figure, its panels, and the times of drawing and saving."""

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

    def receive(self, kind: str, number: int, *values: Any) -> None:
        """Apply a message to the panels."""
        self._is_new = True
        if kind == "panel":
            self._panels.append(PANELS[values[0]](values[1]))
        elif kind == "series":
            self._panels[number].add_series(*values)
        elif kind == "caption":
            self._panels[number].caption = values[0]
        else:
            self._panels[number].add_data(*values)

    def update(self) -> float:
        """Draw and save if it is time; returns the seconds until the next call is due."""
        now_s = time.monotonic()
        is_saved_now = now_s >= self._next_save_s
        if self._is_new and (
            is_saved_now or (self._canvas.is_window and now_s >= self._next_draw_s)
        ):
            self._draw()
            self._is_new = False
            # Drawing that takes long happens less often.
            took_s = time.monotonic() - now_s
            self._next_draw_s = time.monotonic() + max(_REDRAW_S, took_s)
            if is_saved_now:
                self._save()
                self._next_save_s = time.monotonic() + self._save_every_s
        self._canvas.process_events()
        return _EVENTS_S if self._canvas.is_window else self._save_every_s

    def draw_and_save(self) -> None:
        self._draw()
        self._save()

    def _draw(self) -> None:
        try:
            for fault in self._canvas.draw(self._panels):
                self._report(fault)
        except Exception as error:  # of Matplotlib, about a plugin's text
            self._report(f"it cannot be drawn: {error}")

    def _save(self) -> None:
        try:
            self._canvas.save(self._file)
        except Exception as error:  # the disk may have room later, or Matplotlib other data
            self._report(f"{self._file} cannot be saved: {error}")

    def _report(self, text: str) -> None:
        """Print a fault once, though the figure is drawn again and again."""
        if text not in self._faults:
            self._faults.add(text)
            print(f"{self._title}: {text}", file=sys.stderr, flush=True)


def main() -> None:
    """Draw until the node has gone, and save."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the end of the node ends the stream of messages
    messages = MessageReader(0)
    drawing: Drawing | None = None
    pause_s = _EVENTS_S
    while not messages.is_over:
        if messages.wait(pause_s):
            for message in messages.read():
                if message[0] == "figure":
                    drawing = Drawing(*message[1:])
                elif drawing is not None:
                    drawing.receive(*message)
        if drawing is not None:
            pause_s = drawing.update()
    if drawing is not None:
        drawing.draw_and_save()


if __name__ == "__main__":
    main()
