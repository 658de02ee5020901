"""Figures over time: simulated against wall time, and the load of the machine."""

from __future__ import annotations

import csv
import itertools
from pathlib import Path
from typing import Any

from neuros.observe.load_table import FILE_NAME
from neuros.observe.review.run import Run
from neuros.observe.review.style import GREY, colour, new_figure, plain

_SUFFIX = ".cpu_percent"


def time_figure(run: Run) -> Any | None:
    """Simulated against wall time, and the real-time factor of each second; ``None`` without."""
    timelines = {
        name: points for name, points in run.record.get("timeline", {}).items() if len(points) > 1
    }
    if not timelines:
        return None
    figure = new_figure(3.4)
    left, right = (plain(axes) for axes in figure.subplots(1, 2))
    for place, (name, points) in enumerate(timelines.items()):
        sims, walls = zip(*points, strict=True)
        left.plot(walls, sims, color=colour(place), label=name, marker="o", markersize=3)
        factors = [
            (b[0] - a[0]) / (b[1] - a[1]) for a, b in itertools.pairwise(points) if b[1] > a[1]
        ]
        right.step(range(1, len(factors) + 1), factors, where="mid", color=colour(place))
    low, high = left.get_xlim()
    left.axline((low, low), slope=1, color=GREY, linestyle="--", linewidth=1, label="real time")
    left.set_xlim(low, high)
    left.set(xlabel="wall time / s", ylabel="simulated time / s")
    left.legend(frameon=False, fontsize=8)
    right.axhline(1, color=GREY, linestyle="--", linewidth=1)
    right.set(xlabel="simulated second", ylabel="real-time factor", ylim=(0, None))
    return figure


def load_figure(run: Run) -> Any | None:
    """Processor and memory of every node; ``None`` if nothing was recorded."""
    series = read_load(run.folder / FILE_NAME)
    if not series.get("time_s"):
        return None
    figure = new_figure(3.6)
    left, right = (plain(axes) for axes in figure.subplots(1, 2))
    groups = [name.removesuffix(_SUFFIX) for name in series if name.endswith(_SUFFIX)]
    marker = {"marker": "o", "markersize": 3}
    for place, name in enumerate(groups):
        left.plot(series["time_s"], series[name + _SUFFIX], color=colour(place), **marker)
        memory = [each / 1e6 for each in series[f"{name}.memory_bytes"]]
        right.plot(series["time_s"], memory, color=colour(place), label=name, **marker)
    cores = [name for name in series if name.startswith("core")]
    whole = [sum(each) for each in zip(*(series[core] for core in cores), strict=True)]
    label = f"whole machine, {len(cores)} core{'' if len(cores) == 1 else 's'}"
    left.plot(series["time_s"], whole, color=GREY, linestyle="--", label=label)
    left.set(xlabel="wall time / s", ylabel="processor time / % of one core", ylim=(0, None))
    right.set(xlabel="wall time / s", ylabel="resident memory / MB", ylim=(0, None))
    figure.legend(loc="outside lower center", ncols=5, frameon=False, fontsize=8)
    return figure


def read_load(file: Path) -> dict[str, list[float]]:
    """The columns of ``system_load.csv``, NaN where a cell is empty; none if there is no file.

    The last row of a run that was cut off may be broken, and is left out.
    """
    try:
        with open(file, encoding="utf-8", newline="") as lines:
            header, *rows = csv.reader(lines)
    except (OSError, ValueError):
        return {}
    series: dict[str, list[float]] = {name: [] for name in header}
    for row in rows:
        try:
            numbers = [float(cell) if cell else float("nan") for cell in row]
        except ValueError:
            continue
        if len(numbers) == len(header):
            for name, number in zip(header, numbers, strict=True):
                series[name].append(number)
    return series
