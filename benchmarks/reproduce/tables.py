"""Tables of readings: a line per part, medians with their range, published numbers beside them."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from benchmarks.reproduce.kinds import Reading, Readings

NOTHING = "–"


@dataclass(frozen=True)
class Ours:
    """A column of measured figures: a key of :attr:`Reading.figures`, and how it is shown."""

    header: str
    key: str
    form: str = "{:.1f}"


@dataclass(frozen=True)
class Remark:
    """A column of what is no number: a key of :attr:`Reading.remarks`."""

    header: str
    key: str


@dataclass(frozen=True)
class Published:
    """A column of published figures, by part."""

    header: str
    known: Mapping[str, float]


Column = Ours | Remark | Published


@dataclass(frozen=True)
class Table:
    """Ready to be shown: rows of text under headers."""

    name: str
    headers: Sequence[str]
    rows: Sequence[Sequence[str]]

    def write_csv(self, folder: Path) -> Path:
        """Write it, as it is shown but with plain medians only where that is possible."""
        file = folder / f"{self.name}.csv"
        with file.open("w", newline="", encoding="utf-8") as stream:
            csv.writer(stream).writerows([self.headers, *self.rows])
        return file


@dataclass(frozen=True)
class Layout:
    """The columns of a table; ``others`` are rows that were published only."""

    name: str
    columns: Sequence[Column]
    others: Sequence[str] = field(default=())

    def fill(self, parts: Mapping[str, str], readings: Readings) -> Table:
        """The table of these readings, in the order of the parts."""
        headers = ["", *(column.header for column in self.columns)]
        rows = [[other, *self._cells(other, ())] for other in self.others]
        for name, title in parts.items():
            if name in readings:
                rows.append([title, *self._cells(name, readings[name])])
        return Table(self.name, headers, rows)

    def _cells(self, name: str, readings: Sequence[Reading]) -> list[str]:
        return [_cell(column, name, readings) for column in self.columns]


def _cell(column: Column, name: str, readings: Sequence[Reading]) -> str:
    if isinstance(column, Published):
        return f"{column.known[name]:g}" if name in column.known else NOTHING
    if isinstance(column, Remark):
        found = dict.fromkeys(each.remarks.get(column.key, "") for each in readings)
        return ", ".join(found) or NOTHING
    values = values_of(readings, column.key)
    return spread_text(values, column.form)


def values_of(readings: Sequence[Reading], key: str) -> list[float]:
    """A figure of all runs that have it."""
    values = (each.figures.get(key) for each in readings)
    return [value for value in values if value is not None]


def spread_text(values: Sequence[float], form: str) -> str:
    """The median, and in parentheses the smallest and the largest value, if they differ."""
    if not values:
        return NOTHING
    middle, low, high = (form.format(f(values)) for f in (statistics.median, min, max))
    return middle if low == high else f"{middle} ({low} to {high})"


def write_runs(readings: Readings, file: Path) -> None:
    """Every figure of every run, a line per run (CSV)."""
    every = [each for several in readings.values() for each in several]
    remarks = list(dict.fromkeys(key for each in every for key in each.remarks))
    keys = list(dict.fromkeys(key for each in every for key in each.figures))
    with file.open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(["run", *remarks, *keys])
        for each in every:
            known = [each.figures.get(key) for key in keys]
            cells = ["" if value is None else repr(value) for value in known]
            rows.writerow([each.title, *(each.remarks.get(key, "") for key in remarks), *cells])
