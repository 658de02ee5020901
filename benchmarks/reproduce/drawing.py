"""What all figures share. Matplotlib is imported here and in no other module of the experiments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

OURS, THEIRS, TRUTH = "#3465a4", "#c0392b", "0.65"
SERIES = ("#3465a4", "#e08b27", "#1b7f4d")
PUBLISHED = {"marker": "D", "markersize": 7, "color": THEIRS, "markerfacecolor": "white"}
_DPI = 110


@contextmanager
def figure(file: Path, width: float, height: float) -> Iterator[Any]:
    """A figure of inches by inches that is saved at the end of the block."""
    with matplotlib.rc_context(
        {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
    ):
        drawn = Figure(figsize=(width, height), layout="constrained")
        yield drawn
        # The same results give the same file: no version of Matplotlib, no date.
        drawn.savefig(file, dpi=_DPI, metadata={"Software": None})


def panels(drawn: Any, count: int, columns: int) -> list[Any]:
    """As many axes with common scales; surplus ones are switched off."""
    rows = math.ceil(count / columns)
    grid = drawn.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat
    every = list(grid)
    for axes in every[count:]:
        axes.set_visible(False)
    for place, axes in enumerate(every[:count]):
        axes.grid(alpha=0.3)
        axes.tick_params(labelbottom=place + columns >= count)
    return every[:count]


def legend_entry(label: str, **style: Any) -> Any:
    """An entry of a legend that is no line of the axes."""
    return Line2D([], [], label=label, **style)


def bars(
    axes: Any, titles: Sequence[str], series: Sequence[tuple[str, Sequence[float | None]]]
) -> None:
    """Horizontal bars: a group per title, from above; a bar per series, none for ``None``."""
    thickness = 0.8 / len(series)
    for number, (label, values) in enumerate(series):
        offset = (number - (len(series) - 1) / 2) * thickness
        places = [place + offset for place in range(len(titles))]
        widths = [0.0 if value is None else value for value in values]
        colour = SERIES[number % len(SERIES)]
        axes.barh(places, widths, thickness * 0.9, color=colour, label=label)
    axes.set_yticks(range(len(titles)), titles)
    axes.set_ylim(len(titles) - 0.5, -0.5)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
