"""``pytest benchmarks``: every subject measures what it says, quickly; no time is ever judged.

Not part of the tests, for it takes minutes: ``pytest benchmarks -s -k round_trip`` shows the rows.
"""

from __future__ import annotations

import math

import pytest

from benchmarks import running, subjects
from benchmarks.results import Results
from benchmarks.table import rows_table


@pytest.mark.parametrize("name", subjects.names())
def test_a_subject_measures_all_its_rows(name: str) -> None:
    chosen = subjects.load([name], is_quick=True)
    results = Results.here(is_quick=True)

    running.measure(chosen, results, None, print, rounds=1)

    print(rows_table(results.rows))
    assert [each for each in results.notices if each.is_failure] == []
    left_out = {notice.row for notice in results.notices}
    cases = {case.name for group in chosen[name].groups for case in group.cases}
    assert {row.name for row in results.rows} == cases - left_out
    for row in results.rows:
        assert all(math.isfinite(value) for value in (*row.values, *row.references)), row.name
