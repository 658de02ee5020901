"""Metrics: intervals of a timed hook, counted as they pass; what has not arrived at the end."""

from __future__ import annotations

import pytest

from neuros.engine.metrics import TickIntervals, TimeBudget, in_flight_and_lost, time_budget_of

MS = 1_000_000


def book(*starts_ms: float, period_ms: float = 20.0) -> TickIntervals:
    ticks = TickIntervals(round(period_ms * MS))
    for start_ms in starts_ms:
        ticks.record(round(start_ms * MS))
    return ticks


def test_one_tick_makes_no_interval() -> None:
    assert book().figures() is None
    assert book(5).figures() is None


def test_regular_ticks_are_all_within_a_millisecond() -> None:
    figures = book(*range(0, 220, 20)).figures()
    assert figures["intervals"] == 10
    assert figures["mean_ms"] == 20.0
    assert figures["std_ms"] == 0.0
    assert figures["largest_error_ms"] == 0.0
    assert figures["within"] == {"1 ms": 1.0, "2 ms": 1.0, "5 ms": 1.0, "10 ms": 1.0}
    assert figures["histogram"] == [[20.0, 10]]


def test_shares_count_who_is_off_by_no_more_than_that_in_either_direction() -> None:
    # Off by +1, -1.5, +4, -6 and +20 ms.
    figures = book(0, 21, 39.5, 63.5, 77.5, 117.5).figures()
    assert figures["within"] == {"1 ms": 0.2, "2 ms": 0.4, "5 ms": 0.6, "10 ms": 0.8}
    assert figures["min_ms"] == 14.0
    assert figures["max_ms"] == 40.0
    assert figures["largest_error_ms"] == 20.0


def test_the_standard_deviation_is_that_of_the_intervals() -> None:
    figures = book(0, 19, 40, 59, 80).figures()
    assert figures["mean_ms"] == 20.0
    assert figures["std_ms"] == pytest.approx(1.0)


def test_an_interval_that_is_too_short_can_be_the_worst() -> None:
    assert book(0, 12, 32).figures()["largest_error_ms"] == 8.0


def test_its_memory_does_not_grow_with_the_length_of_an_interval() -> None:
    figures = book(0, 1e5, 3e5).figures()
    assert figures["histogram"] == [[2000.0, 2]]


def budget(**seconds: float) -> TimeBudget:
    return TimeBudget(seconds, waiting={}, blocked={}, idle_s=1.0, scheduling_s=0.5)


def test_the_busiest_hook_is_the_one_that_executes_longest() -> None:
    assert budget(first=1.0, plan=3.0, tail=2.0).busiest_hook == ("plan", 3.0)
    assert budget().busiest_hook == ("", 0.0)


def test_a_nodes_own_time_is_that_of_its_hooks_and_of_scheduling() -> None:
    assert budget(a=1.0, b=2.0).own_s == 3.5
    assert budget(a=1.0, b=1.5).share(2.0) == 0.5


def test_a_node_that_has_counted_no_rest_has_rested_for_no_time() -> None:
    accounting = {"executing": {"f": 0.5}, "waiting": {"x": 0.25}, "idle": None}
    found = time_budget_of({"accounting": accounting}, running_s=None)
    assert found == TimeBudget({"f": 0.5}, {"x": 0.25}, {}, idle_s=0.0, scheduling_s=0.0)


def test_of_a_run_that_never_was_under_way_every_share_is_0() -> None:
    assert TimeBudget({}, {}, {}, idle_s=0.0, scheduling_s=0.0).share(0.0) == 0.0


@pytest.mark.parametrize(
    ("outstanding", "has_drained", "in_flight", "lost"),
    [(2, False, 2, 0), (3, False, 2, 0), (1, False, 1, 1), (0, False, 0, 2), (2, True, 0, 2)],
)
def test_what_has_not_arrived_is_in_flight_if_it_was_outstanding_and_nobody_waited_for_it(
    outstanding: int, has_drained: bool, in_flight: int, lost: int
) -> None:
    assert in_flight_and_lost(7, 5, outstanding, has_drained) == (in_flight, lost)
