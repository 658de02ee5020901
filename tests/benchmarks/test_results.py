"""The results file, and the tables that it makes."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.results import Notice, Results
from benchmarks.rows import Row
from benchmarks.table import rows_table, targets_table
from neuros.errors import UsageError


def row(name: str, *values: float, reference: float | None = None, bound: str = "") -> Row:
    references = tuple(reference for _ in values) if reference else ()
    against = "rclpy.spin" if reference else ""
    return Row("round_trip", name, "us", values, against, references, bound or None)


TEN = tuple(100.0 + n for n in range(10))


def test_a_results_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    whole = Results(
        "2026-11-21T08-00-00Z",
        True,
        {"cores": "2"},
        {"python": "3.11.7"},
        {"round_trip": 0.25},
        [Row("s", "r", "us", (1.0, 2.5), "b", (3.0, 4.0), "hook")],
        [Notice("s", "other", "dora-rs is not installed", False)],
        {"s": [[{"a": {"median": 1.0}}]]},
    )
    whole.write(tmp_path / "new" / "a.json")
    assert Results.read(tmp_path / "new" / "a.json") == whole
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a.json"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "No such file"),
        ("", "is no results file"),
        ("[]", "is no results file"),
        ('{"rows": []}', "is no results file"),
        ('{"schema": 99}', "has schema 99; this version reads 3"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, content: str | None, reason: str) -> None:
    file = tmp_path / "x.json"
    if content is not None:
        file.write_text(content)
    with pytest.raises(UsageError, match=reason):
        Results.read(file)


def test_the_table_has_median_interval_ratio_and_verdict() -> None:
    text = rows_table([row("trip", *TEN, reference=200, bound="round-trip-core-each")])
    (line,) = (line for line in text.splitlines() if line.startswith("trip"))
    assert "104 (101 to 108) us" in line
    assert "0.522 (0.505 to 0.54)" in line
    assert line.endswith("yes; goal yes")


def test_fewer_than_ten_rounds_judge_nothing() -> None:
    text = rows_table([row("trip", *TEN[:6], reference=200, bound="round-trip-one-core")])
    assert text.endswith("(within)")


def test_all_targets_are_listed_measured_or_not() -> None:
    rows = [row("idle", *(9.0 for _ in TEN), bound="hook")]
    text = targets_table(rows)
    assert text.count("neuros benchmark ") >= 14
    assert text.count("not measured") >= 14
    assert targets_table(rows, is_whole=False).count("neuros benchmark ") == 1
