"""Comparison of runs: a table and a figure with a column for each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from neuros.analysis.review.charts import colour, new_figure, plain
from neuros.analysis.run_record import PastRun, consumed_percent

_Cells = Callable[[PastRun], float | None]


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
    for name, digits, cell in _figures(runs):
        values = [cell(run) for run in runs]
        if any(value is not None for value in values):
            cells = ["-" if value is None else f"{value:,.{digits}f}" for value in values]
            rows.append([name, *cells, *_ratio(values)])
    return ["", *labels_of(runs), *(["ratio"] if len(runs) == 2 else [])], rows


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


def _figures(runs: Sequence[PastRun]) -> list[tuple[str, int, _Cells]]:
    """Name, digits after the point, and where the value is."""
    figures: list[tuple[str, int, _Cells]] = [
        ("real-time factor", 2, _of("real_time_factor")),
        ("simulated time / s", 2, _of("sim_s")),
        ("wall time / s", 2, _of("wall_s")),
        ("wall time without start and end / s", 2, _of("running_s")),
    ]
    for name in _all(runs, "connections"):
        figures += [
            (f"{name}: discard limit", 0, _in_connection(name, "discard_limit")),
            (f"{name}: sent", 0, _in_connection(name, "sent")),
            (f"{name}: consumed / %", 1, _consumed(name)),
            (f"{name}: rate / Hz", 1, _in_connection(name, "rate_hz")),
            (f"{name}: median latency / ms", 2, _in_connection(name, "latency_ms", "p50")),
            (f"{name}: 99 % latency / ms", 2, _in_connection(name, "latency_ms", "p99")),
        ]
    for name in _all(runs, "nodes"):
        figures += [(f"{name}: executing / %", 1, _executing(name))]
        figures += [(f"{name}: mean processor time / % of a core", 1, _processor(name))]
    return figures


def _all(runs: Sequence[PastRun], what: str) -> list[str]:
    return list(dict.fromkeys(name for run in runs for name in getattr(run, what)))


def _of(key: str) -> _Cells:
    return lambda run: run.record.get(key)


def _in_connection(name: str, *keys: str) -> _Cells:
    def cell(run: PastRun) -> float | None:
        found: Any = run.connections.get(name)
        for key in keys:
            found = None if found is None else found.get(key)
        return None if found is None else float(found)

    return cell


def _consumed(name: str) -> _Cells:
    return lambda run: consumed_percent(run.connections.get(name, {}))


def _executing(name: str) -> _Cells:
    def cell(run: PastRun) -> float | None:
        spent = run.time_budgets.get(name)
        return 100 * spent.shares["executing"] if spent and spent.total_s else None

    return cell


def _processor(name: str) -> _Cells:
    def cell(run: PastRun) -> float | None:
        load: Mapping[str, Any] = run.record.get("system_load") or {}
        figures = load.get("processes", {}).get(name)
        return None if figures is None else float(figures["cpu_percent_mean"])

    return cell


def comparison_figure(runs: Sequence[PastRun]) -> Any | None:
    """Real-time factor, consumed packets, latency, executing share; ``None`` if no run has any."""
    panels = [
        (name, [(label, cell) for label, cell in cells])
        for name, cells in (
            ("real-time factor", [("", _of("real_time_factor"))]),
            ("packets consumed / %", [(n, _consumed(n)) for n in _all(runs, "connections")]),
            (
                "median latency / ms",
                [(n, _in_connection(n, "latency_ms", "p50")) for n in _all(runs, "connections")],
            ),
            ("executing / % of the time", [(n, _executing(n)) for n in _all(runs, "nodes")]),
        )
    ]
    panels = [
        (n, cells) for n, cells in panels if any(c(r) is not None for _, c in cells for r in runs)
    ]
    if not panels:
        return None
    bar = 0.8 / len(runs)
    heights = [max(1.0, len(cells) * (0.2 + 0.16 * len(runs))) for _, cells in panels]
    figure = new_figure(sum(heights) + 0.75 * len(panels) + 0.4)
    ratios = {"height_ratios": heights}
    rows = figure.subplots(len(panels), squeeze=False, gridspec_kw=ratios)[:, 0]
    for axes, (title, cells) in zip(rows, panels, strict=True):
        places = np.arange(len(cells))[::-1]
        for number, (run, label) in enumerate(zip(runs, labels_of(runs), strict=True)):
            values = [cell(run) for _, cell in cells]
            lengths = [0.0 if value is None else value for value in values]
            offsets = places + 0.4 - bar * (number + 0.5)
            axes.barh(offsets, lengths, height=bar * 0.92, color=colour(number), label=label)
            for y, value in zip(offsets, values, strict=True):
                text = " ?" if value is None else f" {value:.3g}"
                axes.text(value or 0.0, y, text, va="center", fontsize=7)
        plain(axes).set_yticks(places, [name for name, _ in cells], fontsize=8)
        if not any(name for name, _ in cells):
            axes.tick_params(axis="y", length=0)
        axes.set_title(title, fontsize=10, loc="left")
        axes.margins(x=0.1)
        axes.grid(visible=False, axis="y")
    handles, labels = rows[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure
