"""Medians, how sure they are, and when a target is reached."""

from __future__ import annotations

import random
import statistics

import pytest

from benchmarks.intervals import Interval, Summary, Verdict, judge, median_interval


@pytest.mark.parametrize(
    ("count", "rank"),
    # As in tables of the sign test: the interval of 95 % runs from the rank-th smallest to the
    # rank-th largest of so many values.
    [(6, 1), (8, 1), (9, 2), (10, 2), (11, 2), (12, 3), (15, 4), (20, 6), (25, 8), (30, 10)],
)
def test_the_interval_of_the_median_is_that_of_the_tables(count: int, rank: int) -> None:
    values = list(range(1, count + 1))
    random.Random(count).shuffle(values)
    assert median_interval(values) == Interval(rank, count + 1 - rank)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_five_values_say_too_little(count: int) -> None:
    assert median_interval(list(range(count))) is None


def test_the_interval_holds_the_true_median_as_often_as_it_says() -> None:
    draw = random.Random(1)
    hits = 0
    for _ in range(2000):
        interval = median_interval([draw.expovariate(1.0) for _ in range(10)])
        assert interval is not None
        hits += interval.low <= 0.6931 <= interval.high
    assert hits / 2000 == pytest.approx(0.979, abs=0.012)


def test_a_summary_has_the_median_and_the_number_of_values() -> None:
    summary = Summary.of([3.0, 1.0, 2.0, 9.0, 4.0, 5.0])
    assert summary == Summary(6, 3.5, Interval(1.0, 9.0))
    assert summary.median == statistics.median([1, 2, 3, 4, 5, 9])


@pytest.mark.parametrize(
    ("low", "high", "is_maximum", "verdict"),
    [
        (0.7, 0.9, True, Verdict.YES),
        (0.7, 1.0, True, Verdict.YES),
        (0.9, 1.1, True, Verdict.WITHIN),
        (1.0, 1.1, True, Verdict.WITHIN),
        (1.01, 1.1, True, Verdict.NO),
        (1.1, 1.2, False, Verdict.YES),
        (0.9, 1.1, False, Verdict.WITHIN),
        (0.8, 0.99, False, Verdict.NO),
    ],
)
def test_a_limit_of_1_is_held_against_the_interval(
    low: float, high: float, is_maximum: bool, verdict: Verdict
) -> None:
    summary = Summary(10, (low + high) / 2, Interval(low, high))
    assert judge(summary, 1.0, is_maximum) is verdict
    assert verdict.is_met == (verdict in (Verdict.YES, Verdict.WITHIN))


def test_without_an_interval_nothing_is_judged() -> None:
    verdict = judge(Summary.of([0.1, 0.1]), 1.0, is_maximum=True)
    assert verdict is Verdict.UNKNOWN
    assert not verdict.is_met
