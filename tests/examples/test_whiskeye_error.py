"""The error of a heading, compared by stamp. Pure arithmetic."""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

FILE = Path(__file__).parents[2] / "examples/4_neurorobotics/whiskeye/heading_error.py"
PERIOD_NS = 20_000_000


def load():
    spec = importlib.util.spec_from_file_location("whiskeye_heading_error_alone", FILE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


heading_error = load()


def turning(rate_rad_s, packets=1000, offset_rad=0.0):
    """A series at 50 Hz, wrapped as headings are."""
    return {
        index * PERIOD_NS: math.remainder(
            rate_rad_s * index * PERIOD_NS * 1e-9 + offset_rad, math.tau
        )
        for index in range(1, packets + 1)
    }


def summary(estimates, truths):
    return heading_error.heading_error(heading_error.compare(estimates, truths))


def test_a_perfect_estimate_has_no_error():
    found = summary(turning(1.0), turning(1.0))
    assert found.samples == 1000
    assert found.rms_deg == pytest.approx(0.0, abs=1e-9)
    assert found.gain == pytest.approx(1.0)
    assert found.drift_deg_s == pytest.approx(0.0, abs=1e-9)


def test_a_constant_lag_is_error_but_neither_gain_nor_drift():
    found = summary(turning(1.0, offset_rad=-0.05), turning(1.0))
    assert found.rms_deg == pytest.approx(math.degrees(0.05))
    assert found.max_deg == pytest.approx(math.degrees(0.05))
    assert found.gain == pytest.approx(1.0)
    assert found.drift_deg_s == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("truth", "estimate"), [(1.0, 1.1), (1.0, -1.0), (-1.0, -0.9), (2.0, 0.0)])
def test_gain_and_drift_tell_a_wrong_rate_even_past_half_a_turn(truth, estimate):
    found = summary(turning(estimate), turning(truth))
    assert found.gain == pytest.approx(estimate / truth)
    assert found.drift_deg_s == pytest.approx(math.degrees(estimate - truth))
    assert found.max_deg == pytest.approx(20.0 * math.degrees(abs(estimate - truth)))


def test_a_robot_that_hardly_turned_has_no_gain():
    found = summary(turning(0.001), turning(0.0))
    assert found.gain is None
    assert found.drift_deg_s == pytest.approx(math.degrees(0.001))


def test_nothing_to_compare_is_no_error_at_all():
    for estimates, truths in (({}, {}), (turning(1.0), {}), ({}, turning(1.0))):
        assert summary(estimates, truths) == heading_error.HeadingError(0)
    assert "unknown" in str(heading_error.HeadingError(0))


def test_estimates_outside_the_known_truth_do_not_count():
    assert summary(turning(1.0, 1000), turning(1.0, 600)).samples == 600


@settings(max_examples=40, deadline=None)
@given(
    rate=st.floats(-2.0, 2.0),
    keep=st.lists(st.booleans(), min_size=400, max_size=400),
)
def test_lost_packets_of_either_series_do_not_change_the_error_of_a_steady_turn(rate, keep):
    estimates, truths = turning(rate, 400, offset_rad=0.1), turning(rate, 400)
    heard = {stamp: truths[stamp] for stamp, kept in zip(truths, keep, strict=True) if kept}
    # Both ends are known, so that every estimate has a truth on either side.
    heard |= {stamp: truths[stamp] for stamp in (min(truths), min(truths) + PERIOD_NS, max(truths))}
    found = summary(estimates, heard)
    assert found.samples == 400
    assert found.max_deg == pytest.approx(math.degrees(0.1), abs=1e-6)


@settings(max_examples=40, deadline=None)
@given(yaw=st.floats(-3.1, 3.1))
def test_yaw_of_a_quaternion_about_the_vertical(yaw):
    quaternion = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    assert heading_error.yaw_of(*quaternion) == pytest.approx(yaw)
    assert isinstance(heading_error.yaw_of(*quaternion), float)
    assert np.isfinite(heading_error.yaw_of(*quaternion))
