"""The results file, several of them, and two of them compared."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.comparing import changes, report
from benchmarks.results import Notice, Origin, Results, combine
from benchmarks.rows import Row
from benchmarks.table import rows_table, targets_table
from neuros.errors import UsageError


def row(name: str, *values: float, reference: float | None = None, bound: str = "") -> Row:
    references = tuple(reference for _ in values) if reference else ()
    against = "rclpy.spin" if reference else ""
    return Row("round_trip", name, "us", values, against, references, bound or None)


def results(*rows: Row, cores: str = "2") -> Results:
    return Results("2026-11-21", machine={"cores": cores}, versions={"x": "1"}, rows=[*rows])


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
        [Origin("2026-11-21T08-00-00Z", "abc", ("s",))],
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
        ('{"schema": 99}', "has schema 99; this version reads 2"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, content: str | None, reason: str) -> None:
    file = tmp_path / "x.json"
    if content is not None:
        file.write_text(content)
    with pytest.raises(UsageError, match=reason):
        Results.read(file)


def test_of_a_row_in_several_files_the_last_one_counts() -> None:
    whole = combine([results(row("a", 1), row("b", 2)), results(row("b", 3), row("c", 4))])
    assert [(each.name, each.values) for each in whole.rows] == [
        ("a", (1,)),
        ("b", (3,)),
        ("c", (4,)),
    ]


def run_of(day: str, commit: str, *rows: Row) -> Results:
    return Results(f"2026-11-{day}T08-00-00Z", versions={"commit": commit}, rows=[*rows])


def subject(name: str, row_name: str) -> Row:
    return Row(name, row_name, "us", (1.0,), "", (), None)


def test_of_several_runs_it_is_said_what_was_measured_on_which_commit() -> None:
    first = run_of("20", "abc", subject("idle", "a"), subject("tick", "a"), subject("tick", "b"))
    second = run_of("22", "def", subject("tick", "b"), subject("whiskeye", "a"))
    third = run_of("21", "abc", subject("memory", "a"))
    whole = combine([first, second, third])
    assert whole.commits == "abc (idle, tick, memory), def (tick, whiskeye)"
    assert whole.days == "2026-11-20 to 2026-11-22"


def test_a_commit_of_which_no_row_is_left_is_not_named() -> None:
    old, new = run_of("20", "abc", subject("idle", "a")), run_of("22", "def", subject("idle", "a"))
    assert (combine([old, new]).commits, combine([old, new]).days) == ("def", "2026-11-22")


def test_what_was_put_together_before_keeps_its_commits() -> None:
    first = run_of("20", "abc", subject("idle", "a"), subject("x", "a"))
    second = run_of("21", "def", subject("x", "b"))
    whole = combine([combine([first, second]), run_of("22", "ghi", subject("y", "a"))])
    assert whole.commits == "abc (idle, x), def (x), ghi (y)"


def test_of_one_run_there_is_one_commit() -> None:
    one = run_of("20", "abc", subject("idle", "a"))
    assert (one.commits, one.days) == ("abc", "2026-11-20")
    assert Results("2026-11-20").commits == "unknown"


def test_a_change_is_marked_where_the_intervals_have_nothing_in_common() -> None:
    a = results(row("same", *TEN), row("slower", *TEN), row("few", 1, 2))
    b = results(
        row("same", *(value + 3 for value in TEN)),
        row("slower", *(value * 2 for value in TEN)),
        row("few", 2, 4),
    )
    assert [change.exceeds_noise for change in changes(a, b)] == [False, True, None]
    text = report(a, b)
    assert "+100.0 %" in text
    assert "warning" not in text


def test_a_ratio_tells_the_noise_of_the_machine_from_a_change() -> None:
    a, b = results(row("r", *TEN, reference=200)), results(row("r", *TEN, reference=100))
    value, ratio = changes(a, b)
    assert (value.name, value.exceeds_noise) == ("", False)
    assert (ratio.name, ratio.exceeds_noise) == ("rclpy.spin", True)
    assert ratio.quotient == pytest.approx(2.0)
    interval = ratio.quotient_interval
    assert interval is not None
    assert interval.low < 2.0 < interval.high


def test_other_machines_and_missing_rows_are_said() -> None:
    text = report(results(row("a", 1)), results(row("b", 1), cores="8"))
    assert "warning: A and B differ in cores: 2 and 8" in text
    assert "only in A: round_trip: a" in text
    assert "only in B: round_trip: b" in text


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
