"""Tuning curves, the population vector and the centre of mass."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuros.snn import (
    CosineTuning,
    GaussianTuning,
    PopulationVector,
    RegularEncoder,
    Spikes,
    centre_of_mass,
    evenly_spaced_angles,
    poisson_spikes,
)

angles = st.floats(-10.0, 10.0)


def apart(a_rad, b_rad):
    return abs(math.remainder(a_rad - b_rad, math.tau))


@given(angles, st.integers(3, 60), st.floats(1.0, 100.0), st.floats(0.0, 1.0))
def test_cosine_tuning_and_the_population_vector_are_inverse(x_rad, neurons, mean_hz, share):
    preferred = evenly_spaced_angles(neurons)
    tuning = CosineTuning(preferred, mean_hz, depth_hz=mean_hz * (0.01 + 0.99 * share))
    found = PopulationVector(preferred).of_rates(tuning.rates_hz(x_rad))
    assert apart(found.angle_rad, x_rad) < 1e-9
    assert -math.pi <= found.angle_rad <= math.pi


@given(angles)
def test_periodic_gaussian_tuning_goes_the_short_way_round(x_rad):
    preferred = evenly_spaced_angles(36)
    tuning = GaussianTuning(preferred, math.radians(20), 80.0, 2.0, period=math.tau)
    rates = tuning.rates_hz(x_rad)
    assert np.allclose(rates, tuning.rates_hz(x_rad + math.tau), atol=1e-9)
    assert np.all((rates >= 2.0) & (rates <= 80.0))
    assert apart(preferred[np.argmax(rates)], x_rad) <= math.pi / 36 + 1e-9
    assert apart(PopulationVector(preferred).of_rates(rates).angle_rad, x_rad) < math.radians(0.01)


def test_a_gaussian_curve_is_its_formula():
    rates = GaussianTuning(np.array([0.0, 1.0, 3.0]), 1.0, peak_hz=11.0, base_hz=1.0).rates_hz(1.0)
    assert rates == pytest.approx([1 + 10 * math.exp(-0.5), 11.0, 1 + 10 * math.exp(-2.0)])


@given(st.floats(-1.0, 1.0))
def test_the_centre_of_mass_is_the_position_where_the_line_goes_on(x):
    preferred = np.arange(-3.0, 3.01, 0.1)
    rates = GaussianTuning(preferred, 0.2, 50.0).rates_hz(x)
    assert centre_of_mass(rates, preferred) == pytest.approx(x, abs=1e-6)


@pytest.mark.parametrize("coder", ["poisson", "regular"])
def test_a_direction_survives_the_way_through_spikes(coder):
    """200 neurons of 50 Hz in half a second are 5000 spikes: a standard error of 1.1 degrees.

    The vector's length is depth / (2 mean) = 1/2; across it each spike has a variance of 1/2.
    """
    preferred, rng = evenly_spaced_angles(200), np.random.default_rng(5)
    tuning, decoder = CosineTuning(preferred, 50.0, 50.0), PopulationVector(preferred)
    sigma_rad = math.sqrt(0.5 / 5000) / 0.5
    regular = RegularEncoder(200, rng)
    for x_rad in np.linspace(-3.0, 3.0, 13):
        rates = tuning.rates_hz(x_rad)
        spikes = (
            poisson_spikes(rates, 0.5, rng) if coder == "poisson" else regular.encode(rates, 0.5)
        )
        found = decoder.of_spikes(spikes)
        assert apart(found.angle_rad, x_rad) < 5 * sigma_rad
        assert found.length == pytest.approx(0.5, abs=0.1)
        assert found.angle_rad == pytest.approx(decoder.of_rates(spikes.counts(200)).angle_rad)


def test_where_nothing_fires_or_all_cancels_there_is_no_direction():
    decoder = PopulationVector(evenly_spaced_angles(8))
    nothing = Spikes(np.zeros(0, dtype=np.int64), np.zeros(0))
    for found in (decoder.of_spikes(nothing), decoder.of_rates(np.full(8, 30.0))):
        assert math.isnan(found.angle_rad)
        assert found.length == 0.0
    assert math.isnan(centre_of_mass(np.zeros(3), np.arange(3.0)))


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: GaussianTuning(np.zeros(2), 0.0, 10.0), "width must be above 0"),
        (lambda: GaussianTuning(np.zeros(2), 1.0, 10.0, 20.0), "from 0 Hz or more"),
        (lambda: GaussianTuning(np.zeros(2), 1.0, 10.0, period=-1.0), "period must be above 0"),
        (lambda: CosineTuning(np.zeros(2), -1.0, 1.0), "from 0 Hz or more"),
        (lambda: PopulationVector([0.0, 1.0]).of_rates([1.0]), r"shape \(2,\)"),
        (lambda: evenly_spaced_angles(0), "neurons must be above 0"),
    ],
)
def test_what_is_no_code_is_refused(make, complaint):
    with pytest.raises(ValueError, match=complaint):
        make()
