"""The figure of the experiment: estimated and true heading over time, and the error below.

A window where there is a display and a toolkit, otherwise the same figure on the Agg canvas.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from heading_error import Array, Comparison, compare
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

REDRAW_PERIOD_S = 0.2
MOST_DRAWN = 20_000
SIZE_INCHES = (7.0, 4.5)
TOOLKITS = ("QtAgg", "TkAgg", "macosx")
NO_WINDOW = "the plot has no window and is saved at the end: "
NO_DISPLAY = NO_WINDOW + "NEUROS_GUI is set, but there is no display"
NO_TOOLKIT = NO_WINDOW + (
    "this Python has no toolkit for one (apt install python3-tk, or PySide6 in the environment)"
)


class HeadingPlot:
    """Draws two series, each ``{stamp in ns: heading in rad}``, when asked and not too often.

    Args:
        every_time: redraw at every call of :meth:`redraw_if_due`, not at most 5 times per second.

    Attributes:
        remark: what the user should know about the window, empty if there is nothing to say.
    """

    def __init__(self, every_time: bool = False) -> None:
        self.redraws = 0
        self._every_time = every_time
        self._next_redraw = time.monotonic()
        self._figure, self.is_window, self.remark = _new_figure()
        self._figure.canvas.mpl_connect("close_event", self._on_closed)
        self._heading_axes, self._error_axes = self._figure.subplots(
            2, 1, sharex=True, gridspec_kw={"height_ratios": (2, 1)}
        )
        self._label()

    def redraw_if_due(self, estimates: dict[int, float], truths: dict[int, float]) -> None:
        """Redraw unless that was done less than a fifth of a second ago (wall time).

        It draws the last 20,000 headings of each series, since a redraw holds up the robot.
        """
        if self._every_time or time.monotonic() >= self._next_redraw:
            self.redraw(_last(estimates), _last(truths))
            self._next_redraw = time.monotonic() + REDRAW_PERIOD_S

    def redraw(self, estimates: Mapping[int, float], truths: Mapping[int, float]) -> Comparison:
        """Redraw now; returns what the lower axes show."""
        comparison = compare(estimates, truths)
        self._estimate_line.set_data(*_broken_at_wraps(estimates))
        self._truth_line.set_data(*_broken_at_wraps(truths))
        error_deg = np.degrees(comparison.error_rad)
        self._error_line.set_data(comparison.time_s, error_deg)
        stamps = [*estimates, *truths] or [0]
        self._fit_axes(min(stamps) * 1e-9, max(stamps) * 1e-9, error_deg)
        self._figure.canvas.draw()
        if self.is_window:
            self._figure.canvas.flush_events()  # here the user's clicks are heeded
        self.redraws += 1
        return comparison

    def save(self, path: Path, caption: str = "") -> None:
        """Write the figure as it was last drawn, with a caption."""
        self._error_axes.set_title(caption, fontsize="x-small", loc="left")
        self._figure.savefig(path)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.is_window:
            from matplotlib import pyplot

            pyplot.close(self._figure)

    def _on_closed(self, event: Any) -> None:
        """The user has closed the window: go on without."""
        if self.is_window:
            self.is_window = False
            FigureCanvasAgg(self._figure)

    def _label(self) -> None:
        above, below = self._heading_axes, self._error_axes
        (self._truth_line,) = above.plot([], [], color="0.6", linewidth=4, label="true heading")
        (self._estimate_line,) = above.plot(
            [], [], ".", color="C3", markersize=3, label="estimate of the network"
        )
        (self._error_line,) = below.plot([], [], color="C0", linewidth=1)
        below.axhline(0.0, color="0.6", linewidth=1)
        above.set(ylabel="heading (deg)", ylim=(-190, 190), yticks=range(-180, 181, 90))
        above.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
        below.set(ylabel="error (deg)", xlabel="simulated time (s)")
        self._fit_axes(0.0, 0.0, np.empty(0))
        self._figure.subplots_adjust(left=0.11, right=0.97, top=0.92, bottom=0.12, hspace=0.2)

    def _fit_axes(self, begin_s: float, end_s: float, error_deg: Array) -> None:
        """Five more seconds at a time, so that the axes stand still in between."""
        begin_s = 5.0 * np.floor(begin_s / 5.0)
        self._error_axes.set_xlim(begin_s, max(begin_s + 5.0, 5.0 * np.ceil(end_s / 5.0 - 1e-6)))
        largest = float(np.max(np.abs(error_deg))) if error_deg.size else 0.0
        bound = 15.0 * max(1.0, np.ceil(largest / 15.0))
        self._error_axes.set_ylim(-bound, bound)


def _new_figure() -> tuple[Figure, bool, str]:
    """A figure, whether it is a window, and a remark for the user."""
    wish, remark = os.environ.get("NEUROS_GUI", ""), ""
    if wish != "0" and _has_display():
        window = _window()
        if window is not None:
            return window, True, ""
        remark = NO_TOOLKIT
    elif wish not in ("", "0"):
        remark = NO_DISPLAY
    figure = Figure(figsize=SIZE_INCHES)
    FigureCanvasAgg(figure)
    return figure, False, remark


def _window() -> Any:
    """A figure in a window, or ``None`` where no window toolkit is installed."""
    from matplotlib import pyplot

    for toolkit in TOOLKITS:
        try:
            pyplot.switch_backend(toolkit)
            figure = pyplot.figure("WhiskEye: head direction", figsize=SIZE_INCHES)
        except Exception:  # ImportError, or the toolkit's own error when the display refuses
            continue
        pyplot.show(block=False)
        return figure
    return None


def _has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")) or (
        sys.platform == "darwin"
    )


def _last(series: dict[int, float]) -> dict[int, float]:
    return dict(islice(reversed(series.items()), MOST_DRAWN))


def _broken_at_wraps(series: Mapping[int, float]) -> tuple[Array, Array]:
    """Times in s and headings in degrees, with a gap in the line where it jumps by a whole turn."""
    stamps = sorted(series)
    time_s = np.array(stamps) * 1e-9
    heading_deg = np.degrees(np.array([series[stamp] for stamp in stamps]))
    jumps = np.flatnonzero(np.abs(np.diff(heading_deg)) > 180.0) + 1
    return np.insert(time_s, jumps, np.nan), np.insert(heading_deg, jumps, np.nan)
