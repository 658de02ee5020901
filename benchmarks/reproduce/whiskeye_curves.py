"""The head direction of WhiskEye and its error: a panel per orchestration, of its first run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reproduce.drawing import OURS, THEIRS, TRUTH, figure, panels
from benchmarks.reproduce.kinds import Readings

_COLUMNS = 4

Titles = Mapping[str, str]


def head_direction(titles: Titles, readings: Readings, file: Path) -> Path:
    """The true heading and the estimates, over simulated time."""
    with _grid(titles, file, "simulated time (s)", "heading (deg)") as every:
        for name, axes in every.items():
            series = readings[name][0].series
            for label, angles, style in (
                ("robot", series.truths, {"color": TRUTH, "markersize": 3}),
                ("network", series.estimates, {"color": THEIRS, "markersize": 1.5}),
            ):
                stamps = sorted(angles)
                heading_deg = [np.degrees(angles[stamp]) for stamp in stamps]
                axes.plot(
                    [stamp * 1e-9 for stamp in stamps], heading_deg, ".", label=label, **style
                )
            axes.set_yticks(range(-180, 181, 90))
            axes.set_title(titles[name], loc="left", fontsize=9)
        handles = axes.get_legend_handles_labels()
        axes.figure.legend(*handles, loc="outside upper right", ncols=2, markerscale=4)
    return file


def heading_error(titles: Titles, readings: Readings, file: Path) -> Path:
    """Estimates minus the true heading, over simulated time."""
    with _grid(titles, file, "simulated time (s)", "error of the heading (deg)") as every:
        for name, axes in every.items():
            series = readings[name][0].series
            axes.axhline(0, color=TRUTH, linewidth=1)
            axes.plot(
                series.time_s, series.error_deg, ".-", color=OURS, linewidth=0.8, markersize=2
            )
            axes.set_title(titles[name], loc="left", fontsize=9)
    return file


@contextmanager
def _grid(titles: Titles, file: Path, x_label: str, y_label: str) -> Iterator[dict[str, Any]]:
    """Axes by part, in a figure that is saved at the end of the block."""
    columns = min(_COLUMNS, len(titles))
    rows = -(-len(titles) // columns)
    with figure(file, 1.0 + 2.4 * columns, 0.6 + 1.9 * rows) as drawn:
        drawn.supxlabel(x_label, fontsize=9)
        drawn.supylabel(y_label, fontsize=9)
        yield dict(zip(titles, panels(drawn, len(titles), columns), strict=True))
