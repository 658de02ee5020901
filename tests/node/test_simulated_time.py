"""Simulated time against wall time."""

from __future__ import annotations

from neuros.node.simulated_time import Timeline


def test_the_first_reading_of_every_simulated_second_is_kept() -> None:
    timeline = Timeline()
    for step in range(11):
        timeline.note(step * 0.25, 100.0 + step)
    assert timeline.take() == [(0.0, 100.0), (1.0, 104.0), (2.0, 108.0)]


def test_what_was_taken_does_not_come_again() -> None:
    timeline = Timeline()
    timeline.note(0.0, 1.0)
    assert timeline.take() == [(0.0, 1.0)]
    timeline.note(0.5, 2.0)
    timeline.note(1.5, 3.0)
    assert timeline.take() == [(1.5, 3.0)]


def test_seconds_that_are_jumped_over_have_no_point() -> None:
    timeline = Timeline()
    timeline.note(0.0, 1.0)
    timeline.note(7.5, 2.0)
    timeline.note(7.9, 3.0)
    timeline.note(8.1, 4.0)
    assert timeline.take() == [(0.0, 1.0), (7.5, 2.0), (8.1, 4.0)]
