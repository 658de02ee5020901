"""A figure of Matplotlib: in a window where there is a display and a toolkit, else in memory."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from neuros.visualise.panels import Panel

_TOOLKITS = ("QtAgg", "TkAgg", "macosx")
_WIDTH_INCHES, _PANEL_INCHES = 9.0, 2.6
_NO_WINDOW = "the figure has no window and is saved only: "
_NO_DISPLAY = _NO_WINDOW + "NEUROS_GUI is set, but there is no display"
_NO_TOOLKIT = _NO_WINDOW + (
    "this Python has no toolkit for one (apt install python3-tk, or PySide6 in the environment)"
)


class Canvas:
    """Draws panels, one below the other.

    Attributes:
        is_window: whether there is one; its user may close it.
        remark: what the user should know of the window, empty if there is nothing to say.
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
            except Exception as error:  # whatever Matplotlib thinks of what a plugin has given
                faults.append(f"'{panel.title}' cannot be drawn: {error}")
                for each in axes:
                    each.clear()
                axes[0].set_title(f"{panel.title}: cannot be drawn", loc="left", fontsize="small")
        self._figure.canvas.draw()
        return faults

    def save(self, path: Path) -> None:
        """Write what was drawn last; whoever looks never finds half of it."""
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
