"""The arithmetic of steps, without NEST."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuros.snn import derive_seed, threads_of_node
from neuros.snn.nest import StepGrid, nanoseconds, nanoseconds_of_ms

GRID = StepGrid(resolution_ns=100_000, min_delay_ns=1_000_000)
WEEKS_NS = 30 * 24 * 3600 * 10**9


@given(st.integers(1, WEEKS_NS))
def test_seconds_are_exact_to_the_nanosecond_for_weeks(time_ns):
    assert nanoseconds(time_ns / 1e9) == time_ns
    assert nanoseconds_of_ms(time_ns / 1e6) == time_ns


@given(st.integers(1, 10**6), st.integers(1, 500_000))
def test_hours_of_equal_steps_in_seconds_do_not_drift(step_in_resolutions, count):
    """Added as floats they would: 0.02 s, 500,000 times, is off by more than 100 ns."""
    duration_s = step_in_resolutions * GRID.resolution_ns / 1e9
    steps = GRID.steps(nanoseconds(duration_s))
    assert steps == step_in_resolutions
    assert steps * count * GRID.resolution_ns == count * round(duration_s * 1e9)


@given(st.integers(-(10**10), 10**10))
def test_a_duration_is_a_whole_number_of_steps_or_refused_with_the_nearest(duration_ns):
    if duration_ns > 0 and duration_ns % 100_000 == 0:
        assert GRID.steps(duration_ns) * 100_000 == duration_ns
        return
    with pytest.raises(ValueError, match=r"is not a whole number of 0\.1 ms, the resolution: "):
        GRID.steps(duration_ns)


@given(st.integers(1, 10**5))
def test_a_step_of_partial_delays_is_told(steps):
    assert bool(GRID.partial_delay(steps * 100_000)) == (steps % 10 != 0)


def test_the_text_names_what_was_asked_for_and_what_is_possible():
    with pytest.raises(ValueError, match=r"a step of 20\.05 ms .*: 20 ms and 20\.1 ms are"):
        GRID.steps(20_050_000)
    assert GRID.partial_delay(500_000).endswith("of 1 ms, the shortest delay: 1 ms is")


@pytest.mark.parametrize("seconds", [float("nan"), float("inf")])
def test_a_duration_without_end_is_refused(seconds):
    with pytest.raises(ValueError, match="finite"):
        nanoseconds(seconds)


@pytest.mark.parametrize("grid", [(0, 1), (1, 0), (100_000, 150_000)])
def test_a_grid_that_cannot_be_is_refused(grid):
    with pytest.raises(ValueError, match=r"must be above 0|not a whole number"):
        StepGrid(*grid)


def test_derived_seeds_differ_by_every_part_and_are_the_same_on_every_machine():
    assert derive_seed(1, "snn") == 167428863
    parts = [(), ("snn",), ("nns",), ("sn", "n"), ("s", "nn"), (0,), ("0",), (1,), ("1",), ("",)]
    found = {derive_seed(seed, *names) for seed in (0, 1, 2) for names in parts}
    assert len(found) == 3 * len(parts)


@given(st.integers(0, 2**64), st.text("aZ0_-é", max_size=40))
def test_a_derived_seed_is_one_that_nest_takes(seed, name):
    assert 1 <= derive_seed(seed, name) < 2**32


@pytest.mark.parametrize(("value", "threads"), [(None, 1), ("2", 2), ("0", 1), ("2,1", 1)])
def test_a_node_has_as_many_threads_as_it_was_given_cores(monkeypatch, value, threads):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if value is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert threads_of_node() == threads
