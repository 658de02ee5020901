"""Two runs side by side: what became more or less, beyond the noise."""

from __future__ import annotations

from dataclasses import dataclass

from tabulate import tabulate

from benchmarks.intervals import Interval, Summary
from benchmarks.results import Results, differences
from benchmarks.rows import Row
from benchmarks.table import number, summary_text

HEADERS = ["measurement", "figure", "A (95 %)", "B (95 %)", "B/A", "change"]


@dataclass(frozen=True)
class Change:
    """How a figure of a row differs between two runs.

    ``name`` is empty for the value, else what it is the ratio to: a ratio within a run does not
    know how busy the machine was, so it tells more than the value.
    """

    row: Row
    name: str
    a: Summary
    b: Summary

    @property
    def quotient(self) -> float:
        """Median of B over median of A."""
        return self.b.median / self.a.median if self.a.median else float("inf")

    @property
    def quotient_interval(self) -> Interval | None:
        """From the least to the greatest quotient of the two intervals: wider than 95 %."""
        if self.a.interval is None or self.b.interval is None or self.a.interval.low <= 0:
            return None
        return Interval(
            self.b.interval.low / self.a.interval.high, self.b.interval.high / self.a.interval.low
        )

    @property
    def exceeds_noise(self) -> bool | None:
        """Whether the intervals have nothing in common; ``None``: too few rounds to say."""
        if self.a.interval is None or self.b.interval is None:
            return None
        return not self.a.interval.overlaps(self.b.interval)


def changes(a: Results, b: Results) -> list[Change]:
    """Of all rows that both have, in the order of B: the value, then the ratio."""
    before = {row.key: row for row in a.rows}
    found = []
    for row in b.rows:
        old = before.get(row.key)
        if old is None or old.unit != row.unit:
            continue
        found.append(Change(row, "", old.summary, row.summary))
        if row.ratios and old.ratios and row.against == old.against:
            found.append(Change(row, row.against, old.judged, row.judged))
    return found


def report(a: Results, b: Results) -> str:
    """What ``--compare`` shows: warnings, the table, rows that only one of them has."""
    lines = [f"warning: A and B differ in {difference}" for difference in differences(a, b)]
    cells = [_cells(change) for change in changes(a, b)]
    lines += ["", tabulate(cells, headers=HEADERS, disable_numparse=True), ""]
    keys_a, keys_b = ({row.key: row for row in each.rows} for each in (a, b))
    lines += [
        f"only in A: {row.subject}: {row.name}" for k, row in keys_a.items() if k not in keys_b
    ]
    lines += [
        f"only in B: {row.subject}: {row.name}" for k, row in keys_b.items() if k not in keys_a
    ]
    lines.append(
        "A change is shown where the 95 % intervals of A and B have nothing in common; ~ is noise,"
        " ? too few rounds (6 at least)."
    )
    return "\n".join(lines).strip()


def _cells(change: Change) -> list[str]:
    unit = "" if change.name else change.row.unit
    quotient = f"{change.quotient:.3g}"
    if change.quotient_interval is not None:
        interval = change.quotient_interval
        quotient += f" ({number(interval.low)} to {number(interval.high)})"
    percent = (change.quotient - 1) * 100
    return [
        "" if change.name else change.row.name,
        f"/ {change.name}" if change.name else "value",
        summary_text(change.a, unit),
        summary_text(change.b, unit),
        quotient,
        {None: "?", False: "~", True: f"{percent:+.1f} %"}[change.exceeds_noise],
    ]
