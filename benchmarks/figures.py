"""Figures of results, as SVG: all targets on one scale, and the curves that subjects declare."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.intervals import Interval, Summary
from benchmarks.measure import Plot
from benchmarks.results import Results
from benchmarks.rows import Row
from benchmarks.table import condition, number, summary_text, symbols
from benchmarks.targets import TARGETS, Bound, Target
from neuros.errors import EnvironmentFault

GOOD, BAD, UNSURE, GOAL = "#1b7f4d", "#c0392b", "#b7791f", "#3465a4"

_HEIGHT_PER_ROW, _WIDTH = 0.3, 9.5
_SCALE = (0.05, 5.0)
"""What is shown of a figure relative to its limit; beyond it a point lies on the edge."""


def draw(results: Results, folder: Path) -> list[Path]:
    """Draw all figures for which there are rows; returns their files.

    Raises:
        EnvironmentFault: without Matplotlib.
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise EnvironmentFault("figures need Matplotlib: ./install.py") from error
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    # The same results give the same files: no date, no random names.
    with matplotlib.rc_context({"svg.hashsalt": "neuros", "font.size": 9}):
        held = list(_held(results.rows))
        if held:
            height = 1.6 + _HEIGHT_PER_ROW * len(held)
            figure = Figure(figsize=(_WIDTH, height), layout="constrained")
            _draw_targets(figure.subplots(), held)
            files.append(_save(figure, folder / "targets.svg"))
        for plot in results.plots:
            curves = _curves(plot, results.rows)
            if curves:
                figure = Figure(figsize=(7.0, 4.2), layout="constrained")
                _draw_curves(figure.subplots(), plot, curves)
                files.append(_save(figure, folder / f"{plot.key}.svg"))
    return files


def _save(figure: Any, file: Path) -> Path:
    figure.savefig(file, metadata={"Date": None})
    return file


def _held(rows: Sequence[Row]) -> Iterator[tuple[Target, Bound, Row]]:
    by_bound = {row.bound: row for row in rows if row.bound}
    for target in TARGETS:
        for bound in target.bounds:
            if bound.key in by_bound:
                yield target, bound, by_bound[bound.key]


def _draw_targets(axes: Any, held: Sequence[tuple[Target, Bound, Row]]) -> None:
    """One line per target: its interval relative to the limit; left of 1 is within it."""
    for position, (_, bound, row) in enumerate(held):
        limit = bound.limit if bound.limit is not None else bound.goal
        assert limit is not None
        relative = _relative(row.judged, limit, bound.is_maximum)
        _draw_interval(axes, position, relative)
        if bound.goal is not None and bound.limit is not None:
            goal = _relative(Summary(1, bound.goal, None), limit, bound.is_maximum)
            axes.plot(goal.median, position, "|", color=GOAL, markersize=14, markeredgewidth=2)
        axes.annotate(
            symbols(
                f"{summary_text(row.judged, '' if row.ratios else row.unit)}   {condition(bound)}"
            ),
            (1.01, position),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=7.5,
        )
    axes.axvline(1.0, color="black", linewidth=1)
    axes.set_xscale("log")
    axes.set_xlim(*_SCALE)
    axes.set_xticks([0.05, 0.1, 0.2, 0.5, 1, 2, 5])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.set_yticks(range(len(held)), [_label(target, bound) for target, bound, _ in held])
    axes.set_ylim(len(held) - 0.5, -0.5)
    axes.grid(axis="x", alpha=0.3)
    axes.set_xlabel("figure relative to its target (no unit; left of 1: reached)")
    axes.set_title(
        "Targets: median with its 95 % interval; blue line: goal", loc="left", fontsize=10
    )


def _draw_interval(axes: Any, position: float, relative: Summary) -> None:
    low, high = _SCALE
    interval = relative.interval or Interval(relative.median, relative.median)
    colour = GOOD if interval.high <= 1 else BAD if interval.low > 1 else UNSURE
    ends = [min(max(end, low), high) for end in (interval.low, interval.high)]
    axes.plot(ends, [position, position], color=colour, linewidth=5, alpha=0.5)
    axes.plot(min(max(relative.median, low), high), position, "o", color=colour, markersize=6)


def _relative(judged: Summary, limit: float, is_maximum: bool) -> Summary:
    """Relative to the limit, so that 1 is at the limit and less is better."""

    def scaled(value: float) -> float:
        return value / limit if is_maximum else limit / max(value, 1e-9)

    interval = judged.interval
    if interval is not None:
        low, high = sorted((scaled(interval.low), scaled(interval.high)))
        interval = Interval(low, high)
    return Summary(judged.count, scaled(judged.median), interval)


def _label(target: Target, bound: Bound) -> str:
    text = target.short if not bound.label else f"{target.short}: {bound.label}"
    return text if bound.limit is not None else f"{text} (goal)"


@dataclass(frozen=True)
class _Curve:
    """The points of a series, from left to right; ``is_own`` is that of NeuROS."""

    is_own: bool
    points: list[tuple[float, Summary]]


def _curves(plot: Plot, rows: Sequence[Row]) -> dict[str, _Curve]:
    curves: dict[str, _Curve] = {}
    for row in rows:
        point = row.point
        if point is None or point.plot != plot.key:
            continue
        if point.series:
            own = curves.setdefault(point.series, _Curve(True, []))
            own.points.append((point.x, row.summary))
        if point.reference_series and row.references:
            other = curves.setdefault(point.reference_series, _Curve(False, []))
            other.points.append((point.x, Summary.of(row.references)))
    for curve in curves.values():
        curve.points.sort(key=lambda each: each[0])
    return curves


def _draw_curves(axes: Any, plot: Plot, curves: dict[str, _Curve]) -> None:
    for name, curve in curves.items():
        medians = [summary.median for _, summary in curve.points]
        intervals = [s.interval or Interval(s.median, s.median) for _, s in curve.points]
        lows = [m - each.low for m, each in zip(medians, intervals, strict=True)]
        highs = [each.high - m for m, each in zip(medians, intervals, strict=True)]
        axes.errorbar(
            [x for x, _ in curve.points],
            medians,
            yerr=[lows, highs],
            label=name,
            marker="o" if curve.is_own else "s",
            linestyle="-" if curve.is_own else "--",
            markersize=4,
            capsize=2,
        )
    if plot.is_log_x:
        axes.set_xscale("log")
        ticks = sorted({x for curve in curves.values() for x, _ in curve.points})
        axes.set_xticks(ticks, [number(x) for x in ticks])
        axes.xaxis.set_minor_formatter("")
    if plot.is_log_y:
        axes.set_yscale("log", subs=[2, 5])
        for formatter in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
            formatter(lambda value, _: number(value))
    else:
        axes.set_ylim(bottom=0)
    axes.set_xlabel(symbols(plot.x_label))
    axes.set_ylabel(symbols(plot.y_label))
    axes.set_title(plot.title, loc="left", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
