"""Accuracy against loss, latency and speed, and against the computing time of the network."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.reproduce.drawing import figure, legend_entry
from benchmarks.reproduce.kinds import Readings
from benchmarks.reproduce.orchestrations import COMPUTING_MS, HERE, ORCHESTRATIONS, PUBLISHED
from benchmarks.reproduce.tables import values_of

ERRORS = {"rms_deg": "RMS at the stamp (deg)", "known_rms_deg": "RMS at the moment (deg)"}
COSTS = {
    "loss_percent": "packets of the IMU lost (%)",
    "latency_ms": "latency (ms)",
    "speed_percent": "speed (% of real time)",
}
COLOURS = ("#3465a4", "#4e9fd1", "#9cc9e3", "#1b7f4d", "#c0392b", "#8e44ad", "#e08b27")
TIMES = {
    PUBLISHED: ("times of the published machine", {"marker": "o", "markerfacecolor": "white"}),
    HERE: ("times of this machine", {"marker": "D"}),
    "": ("network of 15 to 120 ms, world in real time", {"marker": ".", "markersize": 4}),
}


def draw_costs(readings: Readings, file: Path) -> Path:
    """A panel per cost and kind of error; bars reach from the least to the largest seed."""
    with figure(file, 10.0, 6.4) as drawn:
        every = drawn.subplots(len(ERRORS), len(COSTS), sharex="col", sharey="row")
        for (error, y_label), row in zip(ERRORS.items(), every, strict=True):
            for cost, axes in zip(COSTS, row, strict=True):
                for name, colour in zip(ORCHESTRATIONS, COLOURS, strict=True):
                    for how, (_, style) in TIMES.items():
                        hows = [how] if how else [f"{ms}ms" for ms in COMPUTING_MS]
                        parts = [f"{name}.{each}" for each in hows]
                        _bars(axes, readings, parts, (cost, error), {"color": colour, **style})
                axes.grid(alpha=0.3)
                axes.set_yscale("log")
                axes.yaxis.set_major_formatter("{x:g}")
                if cost != "loss_percent":
                    axes.set_xscale("log")
                    axes.xaxis.set_major_formatter("{x:g}")
            row[0].set_ylabel(y_label)
        for axes, label in zip(every[-1], COSTS.values(), strict=True):
            axes.set_xlabel(label)
        colours = zip(ORCHESTRATIONS.values(), COLOURS, strict=True)
        handles = [legend_entry(title, color=colour) for title, colour in colours]
        for label, style in TIMES.values():
            handles.append(legend_entry(label, color="0.3", linestyle="", **style))
        drawn.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=8)
    return file


def _bars(
    axes: Any, readings: Readings, parts: list[str], keys: tuple[str, str], style: dict[str, Any]
) -> None:
    """The medians of parts, with their ranges; several are joined by a line."""
    several = [[values_of(readings.get(part, ()), key) for key in keys] for part in parts]
    found = [values for values in several if all(values)]
    if found:
        x, y = ([median(values[axis]) for values in found] for axis in (0, 1))
        ranges = [
            [
                [median(v[axis]) - min(v[axis]) for v in found],
                [max(v[axis]) - median(v[axis]) for v in found],
            ]
            for axis in (0, 1)
        ]
        axes.errorbar(x, y, xerr=ranges[0], yerr=ranges[1], linewidth=0.8, **style)


def draw_computing(readings: Readings, file: Path) -> Path:
    """A line per orchestration; bands reach from the least to the largest seed."""
    with figure(file, 10.0, 4.4) as drawn:
        every = drawn.subplots(1, len(ERRORS), sharex=True, sharey=True)
        for (error, y_label), axes in zip(ERRORS.items(), every, strict=True):
            for title, colour, width, found in _lines(readings, error):
                middle = [median(values) for values in found.values()]
                style = {"color": colour, "linewidth": width, "markersize": width + 2}
                axes.plot([*found], middle, "o-", label=title, **style)
                low, high = ([f(values) for values in found.values()] for f in (min, max))
                axes.fill_between([*found], low, high, color=colour, alpha=0.15, linewidth=0)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xticks(COMPUTING_MS, [f"{ms:g}" for ms in COMPUTING_MS])
            axes.minorticks_off()
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_xlabel("computing time of the network per packet (ms)")
            axes.set_ylabel(y_label)
            axes.grid(alpha=0.3)
        handles, labels = every[0].get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower center", ncols=7, fontsize=8)
    return file


def _lines(
    readings: Readings, error: str
) -> Iterator[tuple[str, str, float, dict[int, list[float]]]]:
    """Title, colour and width of each line, and the errors of all seeds by computing time.

    Lines become thinner, so that one can be seen below another.
    """
    width = 5.0
    for (name, title), colour in zip(ORCHESTRATIONS.items(), COLOURS, strict=True):
        found = {
            ms: values
            for ms in COMPUTING_MS
            if (values := values_of(readings.get(f"{name}.{ms}ms", ()), error))
        }
        if found:
            yield title, colour, width, found
        width -= 0.65
