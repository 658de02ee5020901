"""Simulated time against wall time."""

from __future__ import annotations

import pytest

from neuros.node.simulated_time import Timeline

LATER_S = 61.0
"""When a timeline is as coarse as it stays."""


@pytest.fixture
def timeline() -> Timeline:
    """One that is past its first minute."""
    timeline = Timeline()
    timeline.add(0.0, 0.0)
    assert timeline.pop() == [(0.0, 0.0)]
    return timeline


def test_the_first_reading_of_every_simulated_second_is_kept(timeline: Timeline) -> None:
    for step in range(11):
        timeline.add(step * 0.25, LATER_S + step)
    assert timeline.pop() == [(1.0, LATER_S + 4), (2.0, LATER_S + 8)]


def test_in_the_first_minute_so_is_one_each_tenth_of_a_second() -> None:
    timeline = Timeline()
    for step in range(6):
        timeline.add(0.0, 0.0625 * step)
    assert timeline.pop() == [(0.0, 0.0), (0.0, 0.125), (0.0, 0.25)]


def test_what_was_taken_does_not_come_again(timeline: Timeline) -> None:
    timeline.add(0.5, LATER_S)
    timeline.add(1.5, LATER_S + 1)
    assert timeline.pop() == [(1.5, LATER_S + 1)]
    assert timeline.pop() == []


def test_seconds_that_are_jumped_over_have_no_point(timeline: Timeline) -> None:
    timeline.add(7.5, LATER_S)
    timeline.add(7.9, LATER_S + 1)
    timeline.add(8.1, LATER_S + 2)
    assert timeline.pop() == [(7.5, LATER_S), (8.1, LATER_S + 2)]


def test_where_time_goes_back_the_last_reading_and_the_new_one_are_kept(timeline: Timeline) -> None:
    for place, sim_s in enumerate((7.5, 7.9, 0.2, 0.4, 1.5)):
        timeline.add(sim_s, LATER_S + place)
    assert timeline.pop() == [
        (7.5, LATER_S),
        (7.9, LATER_S + 1),
        (0.2, LATER_S + 2),
        (1.5, LATER_S + 4),
    ]
