"""Comparison of runs: their figures, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tabulate import tabulate

from neuros_analysis.review import ReviewedRun

_Figures = dict[tuple[str, int], float | None]
"""Values by name and number of decimals."""


def consumed_percent(connection: Mapping[str, Any]) -> float | None:
    """The share of the packets sent on a connection that were consumed, in per cent."""
    sent, consumed = connection.get("sent"), connection.get("consumed")
    return 100 * consumed / sent if sent and consumed is not None else None


def labels_of(runs: Sequence[ReviewedRun]) -> list[str]:
    """A short name for each run that tells it from the others."""
    names = [run.folder.resolve().name for run in runs]
    if len({*names}) < len(names):
        names = [str(run.folder) for run in runs]
    if len({*names}) < len(names):
        names = [f"{place}: {name}" for place, name in enumerate(names, 1)]
    return names


def comparison_rows(runs: Sequence[ReviewedRun]) -> tuple[list[str], list[list[str]]]:
    """A header, and rows: a name, its value in each run, and of two runs the ratio B / A."""
    rows = []
    for (name, digits), values in _side_by_side(runs).items():
        cells = ["-" if value is None else f"{value:,.{digits}f}" for value in values]
        if len(values) == 2:
            a, b = values
            cells.append("-" if a is None or b is None or not a else f"{b / a:.2f}")
        rows.append([name, *cells])
    return ["", *labels_of(runs), *(["ratio"] if len(runs) == 2 else [])], rows


def figures_of(runs: Sequence[ReviewedRun]) -> dict[str, list[float | None]]:
    """By name, the value in each run; ``None`` where a run does not have it."""
    return {name: values for (name, _), values in _side_by_side(runs).items()}


def comparison_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    align = ("left", *("right" for _ in header[1:])) if rows else None
    return str(tabulate(rows, headers=header, disable_numparse=True, colalign=align))


def _side_by_side(runs: Sequence[ReviewedRun]) -> dict[tuple[str, int], list[float | None]]:
    """The value in each run by name and number of decimals; rows without any value are left out."""
    parts = [_figures(run) for run in runs]
    found = {}
    for part in zip(*parts, strict=True):  # the same part of all runs
        for key in dict.fromkeys(key for figures in part for key in figures):
            values = [figures.get(key) for figures in part]
            if any(value is not None for value in values):
                found[key] = values
    return found


def _figures(run: ReviewedRun) -> tuple[_Figures, _Figures, _Figures]:
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
