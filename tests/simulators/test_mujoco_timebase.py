"""Simulated time is counted, not added up."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.simulators.mujoco.timing import FiringSchedule, Timebase

HOUR_S = 3600


@pytest.mark.parametrize("timestep_s", [0.001, 0.002, 0.0005, 0.005, 0.01])
def test_stamps_are_exact_for_every_firing_of_an_hour(timestep_s):
    time, rate_hz = Timebase(timestep_s), 50
    period = time.period_steps(rate_hz)
    period_ns = 1_000_000_000 // rate_hz
    for firing in range(1, HOUR_S * rate_hz + 1):
        assert time.nanoseconds(firing * period) == firing * period_ns


def test_a_timestep_that_decimals_cannot_hold_does_not_drift_either():
    time = Timebase(0.0041666667)  # 1/240 s
    assert time.period_steps(60) == 4
    assert time.nanoseconds(HOUR_S * 240) == HOUR_S * 1_000_000_000
    assert time.seconds(HOUR_S * 240) == HOUR_S


def test_an_unusual_timestep_is_taken_as_written():
    assert Timebase(0.0001234).nanoseconds(10_000) == 1_234_000_000


@pytest.mark.parametrize(
    ("timestep_s", "rate_hz", "steps"),
    [
        (0.002, 50, 10),
        (0.001, 50.0, 20),
        (0.002, 500, 1),
        (0.001, 16.6666667, 60),
        (0.001, 0.5, 2000),
    ],
)
def test_a_rate_is_a_whole_number_of_steps(timestep_s, rate_hz, steps):
    assert Timebase(timestep_s).period_steps(rate_hz) == steps


@pytest.mark.parametrize(
    ("rate_hz", "says"),
    [
        (30, "31.25 Hz (every 16 steps) and 29.41176471 Hz (every 17 steps)"),
        (1000, "period of 0.5 timesteps of 0.002 s"),
        (333, "not a whole number"),
    ],
)
def test_other_rates_are_refused_with_their_neighbours(rate_hz, says):
    with pytest.raises(ValueError, match="timesteps") as caught:
        Timebase(0.002).period_steps(rate_hz)
    assert says in str(caught.value)


@given(step=st.integers(0, 10**12), periods=st.lists(st.integers(1, 10**6), min_size=1, max_size=5))
@settings(max_examples=100)
def test_the_next_firing_is_the_first_multiple_of_any_period(step, periods):
    schedule = FiringSchedule({str(i): period for i, period in enumerate(periods)})
    firing = schedule.next_firing(step)
    assert firing > step
    assert schedule.due(firing)
    assert all(firing <= (step // period + 1) * period for period in periods)


@given(
    period=st.integers(1, 50),
    step=st.integers(0, 200),
    count=st.integers(1, 200),
    is_unread=st.booleans(),
)
@settings(max_examples=200)
def test_a_crossing_is_two_firings_without_a_read_between(period, step, count, is_unread):
    is_unread = is_unread and step >= period
    firings = sum(1 for at in range(step + 1, step + count + 1) if at % period == 0)
    crossing = FiringSchedule({"s": period}).find_crossing(
        {"s"} if is_unread else (), step, step + count
    )
    assert (crossing is not None) == (firings + is_unread >= 2)


def test_nothing_fires_at_time_zero():
    schedule = FiringSchedule({"a": 10, "b": 20})
    assert schedule.due(0) == ()
    assert schedule.due(10) == ("a",)
    assert schedule.due(20) == ("a", "b")


@given(steps=st.integers(0, 10**10))
@settings(max_examples=50)
def test_nanoseconds_are_the_nearest_to_the_true_time(steps):
    true = Fraction(steps, 240) * 10**9
    assert abs(Timebase(1 / 240).nanoseconds(steps) - true) <= Fraction(1, 2)
