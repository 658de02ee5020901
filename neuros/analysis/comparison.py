"""Comparison of runs: a table and a figure with a column for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from neuros.analysis.charts import add_legend, colour, new_figure, plain
from neuros.analysis.run_record import PastRun, consumed_percent

_Figures = dict[tuple[str, int], float | None]
"""Values by their name and the digits after the point."""


def labels_of(runs: Sequence[PastRun]) -> list[str]:
    """A short name for each run that tells it from the others."""
    names = [run.folder.resolve().name for run in runs]
    if len({*names}) < len(names):
        names = [str(run.folder) for run in runs]
    if len({*names}) < len(names):
        names = [f"{place}: {name}" for place, name in enumerate(names, 1)]
    return names


def comparison_rows(runs: Sequence[PastRun]) -> tuple[list[str], list[list[str]]]:
    """A header, and rows: what, its value in each run, and of two runs the ratio B / A."""
    rows = []
    for (name, digits), values in _side_by_side(runs).items():
        cells = ["-" if value is None else f"{value:,.{digits}f}" for value in values]
        rows.append([name, *cells, *_ratio(values)])
    return ["", *labels_of(runs), *(["ratio"] if len(runs) == 2 else [])], rows


def figures_of(runs: Sequence[PastRun]) -> dict[str, list[float | None]]:
    """By name, the value in each run; ``None`` where a run does not have it."""
    return {name: values for (name, _), values in _side_by_side(runs).items()}


def comparison_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The rows as text."""
    from tabulate import tabulate

    align = ("left", *("right" for _ in header[1:])) if rows else None
    return str(tabulate(rows, headers=header, disable_numparse=True, colalign=align))


def _ratio(values: Sequence[float | None]) -> list[str]:
    if len(values) != 2:
        return []
    a, b = values
    return ["-" if a is None or b is None or not a else f"{b / a:.2f}"]


def _side_by_side(runs: Sequence[PastRun]) -> dict[tuple[str, int], list[float | None]]:
    """By name and digits after the point, the value in each run; what no run has is left out."""
    parts = [_figures(run) for run in runs]
    found = {}
    for part in zip(*parts, strict=True):  # of all runs, before the next part of any
        for key in dict.fromkeys(key for figures in part for key in figures):
            values = [figures.get(key) for figures in part]
            if any(value is not None for value in values):
                found[key] = values
    return found


def _figures(run: PastRun) -> tuple[_Figures, _Figures, _Figures]:
    """Of the run, its connections and its nodes."""
    record = run.record
    whole: _Figures = {
        ("real-time factor", 2): record.get("real_time_factor"),
        ("simulated time / s", 2): record.get("sim_s"),
        ("wall time / s", 2): record.get("wall_s"),
        ("wall time without start and end / s", 2): record.get("running_s"),
    }
    connections: _Figures = {}
    for name, figures in run.connections.items():
        latency_ms = figures.get("latency_ms") or {}
        connections |= {
            (f"{name}: discard limit", 0): figures.get("discard_limit"),
            (f"{name}: sent", 0): figures.get("sent"),
            (f"{name}: consumed / %", 1): consumed_percent(figures),
            (f"{name}: rate / Hz", 1): figures.get("rate_hz"),
            (f"{name}: median latency / ms", 2): latency_ms.get("p50"),
            (f"{name}: 99 % latency / ms", 2): latency_ms.get("p99"),
        }
    nodes: _Figures = {}
    loads = (record.get("system_load") or {}).get("processes", {})
    for name in run.nodes:
        spent, load = run.time_budgets.get(name), loads.get(name) or {}
        executing = 100 * spent.shares["executing"] if spent and spent.total_s else None
        processor = load.get("cpu_percent_mean")
        nodes |= {
            (f"{name}: executing / %", 1): executing,
            (f"{name}: mean processor time / % of a core", 1): processor,
        }
    return whole, connections, nodes


def comparison_figure(runs: Sequence[PastRun]) -> Any | None:
    """Real-time factor, consumed packets, latency, executing share; ``None`` if no run has any."""
    found = {name: values for (name, _), values in _side_by_side(runs).items()}
    nothing: list[float | None] = [None for _ in runs]
    connections = dict.fromkeys(name for run in runs for name in run.connections)
    nodes = dict.fromkeys(name for run in runs for name in run.nodes)
    panels = {
        "real-time factor": {"": "real-time factor"},
        "packets consumed / %": {name: f"{name}: consumed / %" for name in connections},
        "median latency / ms": {name: f"{name}: median latency / ms" for name in connections},
        "executing / % of the time": {name: f"{name}: executing / %" for name in nodes},
    }
    panels = {
        title: rows for title, rows in panels.items() if any(key in found for key in rows.values())
    }
    if not panels:
        return None
    bar = 0.8 / len(runs)
    heights = [max(1.0, len(rows) * (0.2 + 0.16 * len(runs))) for rows in panels.values()]
    figure = new_figure(sum(heights) + 0.75 * len(panels) + 0.4)
    ratios = {"height_ratios": heights}
    all_axes = figure.subplots(len(panels), squeeze=False, gridspec_kw=ratios)[:, 0]
    for axes, (title, rows) in zip(all_axes, panels.items(), strict=True):
        places = np.arange(len(rows))[::-1]
        for number, label in enumerate(labels_of(runs)):
            values = [found.get(key, nothing)[number] for key in rows.values()]
            lengths = [0.0 if value is None else value for value in values]
            offsets = places + 0.4 - bar * (number + 0.5)
            axes.barh(offsets, lengths, height=bar * 0.92, color=colour(number), label=label)
            for y, value in zip(offsets, values, strict=True):
                text = " ?" if value is None else f" {value:.3g}"
                axes.text(value or 0.0, y, text, va="center", fontsize=7)
        plain(axes).set_yticks(places, [*rows], fontsize=8)
        if [*rows] == [""]:
            axes.tick_params(axis="y", length=0)
        axes.set_title(title, fontsize=10, loc="left")
        axes.margins(x=0.1)
        axes.grid(visible=False, axis="y")
    handles, labels = all_axes[0].get_legend_handles_labels()
    add_legend(figure, 4, handles=handles, labels=labels)
    return figure
