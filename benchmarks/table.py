"""The tables: all rows, and the targets with what was found for each of them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from tabulate import tabulate

from benchmarks.intervals import Summary
from benchmarks.measure import MINIMUM_PAIRS
from benchmarks.results import Notice
from benchmarks.rows import Row
from benchmarks.targets import TARGETS, Bound, Target

ROW_HEADERS = [
    "measurement",
    "median (95 %)",
    "range",
    "against",
    "ratio (95 %)",
    "rounds",
    "target",
    "met",
]
TARGET_HEADERS = ["target", "against", "figure (95 %)", "at most / least", "met", "measured by"]

LEGEND = (
    "Medians, with the 95 % interval of the median. Met: yes: the whole interval reaches the"
    " target; within: the interval contains the target; NO: no part reaches it; in parentheses:"
    " fewer than 10 rounds; ?: too few rounds."
)


def rows_table(rows: Sequence[Row], style: str = "simple") -> str:
    """All rows."""
    cells = [_row_cells(row) for row in rows]
    return tabulate(cells, headers=ROW_HEADERS, tablefmt=style, disable_numparse=True)


def targets_table(rows: Sequence[Row], style: str = "simple", is_whole: bool = True) -> str:
    """The targets in the order of the table of targets, those that were not measured, too.

    Args:
        is_whole: otherwise only the targets that were measured.
    """
    by_bound = {row.bound: row for row in rows if row.bound}
    cells = []
    for target in TARGETS:
        found = [by_bound.get(bound.key) for bound in target.bounds]
        if is_whole or any(found):
            cells += _target_cells(target, found)
    return tabulate(cells, headers=TARGET_HEADERS, tablefmt=style, disable_numparse=True)


def notice_lines(notices: Sequence[Notice]) -> list[str]:
    """One line per row that was left out or failed."""
    return [
        f"{'FAILED' if each.is_failure else 'left out'}: {each.subject}: {each.row}: {each.reason}"
        for each in notices
    ]


def number(value: float) -> str:
    """Three digits, and no exponent where it does not help."""
    if 1000 <= abs(value) < 1e9:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def summary_text(summary: Summary, unit: str = "") -> str:
    """Median, interval, unit."""
    text = number(summary.median)
    if summary.interval is not None:
        text += f" ({number(summary.interval.low)} to {number(summary.interval.high)})"
    return f"{text} {unit}".strip()


def symbols(text: str) -> str:
    """What a terminal shows in letters, in the symbols of a page or figure."""
    text = re.sub(r"\bus\b", "µs", text)
    return text.replace("<=", "≤").replace(">=", "≥")


def met(row: Row, limit: float | None) -> str:
    """The verdict, in parentheses where it rests on too few rounds to count."""
    verdict = row.verdict(limit)
    if verdict is None:
        return ""
    return verdict.value if row.judged.count >= MINIMUM_PAIRS else f"({verdict.value})"


def condition(bound: Bound) -> str:
    """Limit and goal of a bound."""
    limit = "" if bound.limit is None else bound.text(bound.limit)
    goal = "" if bound.goal is None else f"goal {bound.text(bound.goal)}"
    return "; ".join(part for part in (limit, goal) if part)


def _row_cells(row: Row) -> list[str]:
    bound = row.bound_or_none
    return [
        row.name,
        summary_text(row.summary, row.unit),
        f"{number(min(row.values))} to {number(max(row.values))}",
        row.against,
        summary_text(Summary.of(row.ratios)) if row.ratios else "",
        str(len(row.values)),
        "" if bound is None else condition(bound),
        "" if bound is None else _both_met(row, bound),
    ]


def _both_met(row: Row, bound: Bound) -> str:
    """The verdict on the limit, and on the goal behind it."""
    goal = "" if bound.goal is None else f"goal {met(row, bound.goal)}"
    return "; ".join(part for part in (met(row, bound.limit), goal) if part)


def _target_cells(target: Target, rows: Sequence[Row | None]) -> list[list[str]]:
    """One line per bound; the later ones say only what differs."""
    lines: list[list[str]] = []
    for bound, row in zip(target.bounds, rows, strict=True):
        figure = "not measured" if row is None else summary_text(row.judged, _unit(row))
        command = f"neuros benchmark {target.subject}"
        first = [target.what, target.reference] if not lines else ["", ""]
        if bound.label:
            first[0] = f"{first[0]}: {bound.label}".removeprefix(": ")
        verdict = "" if row is None else _both_met(row, bound)
        lines.append([*first, figure, condition(bound), verdict, "" if lines else command])
    return lines


def _unit(row: Row) -> str:
    return "" if row.ratios else row.unit
