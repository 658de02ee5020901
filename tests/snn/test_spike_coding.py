"""Rates to spikes and back, without a simulator.

Statistical bounds are five standard deviations of what is tested (one correct coder in about two
million fails), at fixed seeds: they cannot fail by chance from one run to the next.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.snn import (
    ExponentialRate,
    LeakyIntegrator,
    RegularEncoder,
    Spikes,
    WindowRate,
    poisson_spikes,
)

SIGMAS = 5.0
NOTHING = Spikes(np.zeros(0, dtype=np.int64), np.zeros(0))

rates_of_some = st.lists(st.floats(0.0, 500.0), min_size=1, max_size=5)
durations = st.lists(st.floats(1e-4, 0.5), min_size=1, max_size=20)


def generator(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize("rate_hz", [0.5, 20.0, 900.0])
def test_poisson_spikes_have_the_rate_and_the_variance_of_a_poisson_process(rate_hz):
    neurons, duration_s = 1000, 1.0
    counts = poisson_spikes(np.full(neurons, rate_hz), duration_s, generator()).counts(neurons)
    mean = rate_hz * duration_s
    assert counts.mean() == pytest.approx(mean, abs=SIGMAS * math.sqrt(mean / neurons))
    # var(s^2) = (mu4 - sigma^4) / n, and a Poisson count has mu4 = mean + 3 mean^2.
    spread = math.sqrt((mean + 2 * mean**2) / neurons)
    assert counts.var() == pytest.approx(mean, abs=SIGMAS * spread)


def test_intervals_of_poisson_spikes_are_exponential():
    spikes = poisson_spikes([100.0], 400.0, generator(2))
    intervals = np.diff(spikes.time_s)
    assert intervals.mean() == pytest.approx(0.01, rel=SIGMAS / math.sqrt(intervals.size))
    # Kolmogorov-Smirnov: the distance beyond which one sample in a million lies is 2.7 / sqrt(n).
    ordered = np.sort(intervals)
    found = np.arange(1, ordered.size + 1) / ordered.size
    distance = np.max(np.abs(found - (1.0 - np.exp(-ordered / 0.01))))
    assert distance < 2.7 / math.sqrt(ordered.size)


@given(rates_of_some, st.floats(1e-3, 1.0), st.floats(0.0, 1e4))
def test_poisson_spikes_lie_in_their_window_in_order(rates, duration_s, start_s):
    spikes = poisson_spikes(rates, duration_s, generator(), start_s)
    assert np.all(spikes.time_s >= start_s)
    assert np.all(spikes.time_s <= start_s + duration_s)
    assert np.all(np.diff(spikes.time_s) >= 0.0)
    assert np.all(np.array(rates)[spikes.neuron] > 0.0)


def test_the_same_generator_state_gives_the_same_spikes():
    first, second = (poisson_spikes([50.0] * 10, 1.0, generator(7)) for _ in range(2))
    assert np.array_equal(first.time_s, second.time_s)
    assert np.array_equal(first.neuron, second.neuron)
    other = poisson_spikes([50.0] * 10, 1.0, generator(8))
    assert not np.array_equal(first.time_s, other.time_s)


@given(rates_of_some, durations, st.integers(0, 2**32))
def test_a_regular_train_is_less_than_a_spike_off_the_integral_of_its_rate(rates, lengths, seed):
    encoder = RegularEncoder(len(rates), generator(seed))
    phase = encoder.phase
    counts, start_s = np.zeros(len(rates)), 0.0
    for length in lengths:
        spikes = encoder.encode(rates, length, start_s)
        assert np.all(spikes.time_s >= start_s)
        assert np.all(spikes.time_s <= start_s + length)
        counts += spikes.counts(len(rates))
        start_s += length
    integral = phase + np.array(rates) * sum(lengths)
    assert np.all(np.abs(counts + encoder.phase - integral) < 1e-9 * (1.0 + integral))


@given(st.floats(1.0, 500.0), durations)
def test_a_regular_train_is_the_same_in_windows_as_in_one(rate_hz, lengths):
    encoder, start_s, times = RegularEncoder(1), 0.0, []
    for length in lengths:
        times.extend(encoder.encode([rate_hz], length, start_s).time_s)
        start_s += length
    assert np.allclose(np.array(times), np.arange(1, len(times) + 1) / rate_hz, atol=1e-9, rtol=0)


def test_regular_trains_of_equal_rates_do_not_fire_together():
    spikes = RegularEncoder(100, generator()).encode([10.0] * 100, 0.1)
    assert len(set(spikes.time_s)) == len(spikes) == 100


def decoded(decoder, rates, lengths):
    """Rates after Poisson spikes in steps of these lengths, when that is, and every spike."""
    rng, now_s, everything = generator(), 0.0, []
    for length in lengths:
        spikes = poisson_spikes(rates, length, rng, now_s)
        everything.extend(zip(spikes.neuron, spikes.time_s, strict=True))
        now_s += length
        found = decoder.update(spikes, now_s)
    return found, now_s, everything


@given(rates_of_some, durations, st.floats(1e-3, 1.0))
def test_the_window_holds_the_spikes_of_its_last_seconds(rates, lengths, window_s):
    found, now_s, everything = decoded(WindowRate(len(rates), window_s), rates, lengths)
    expected = np.zeros(len(rates))
    for neuron, time_s in everything:
        expected[neuron] += time_s > now_s - window_s
    assert np.array_equal(found, expected / window_s)


@settings(max_examples=50)
@given(rates_of_some, durations, st.floats(1e-3, 1.0))
def test_the_exponential_filter_is_its_formula_whatever_the_steps(rates, lengths, tau_s):
    found, now_s, everything = decoded(ExponentialRate(len(rates), tau_s), rates, lengths)
    expected = np.zeros(len(rates))
    for neuron, time_s in everything:
        expected[neuron] += math.exp((time_s - now_s) / tau_s) / tau_s
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("decoder", [WindowRate, ExponentialRate])
def test_decoded_poisson_rates_are_unbiased(decoder):
    neurons, rate_hz, scale_s = 4000, 40.0, 0.1
    spikes = poisson_spikes(np.full(neurons, rate_hz), 3.0, generator(3))
    found = decoder(neurons, scale_s).update(spikes, 3.0)
    variance = {WindowRate: rate_hz / scale_s, ExponentialRate: rate_hz / (2 * scale_s)}[decoder]
    assert found.mean() == pytest.approx(rate_hz, abs=SIGMAS * math.sqrt(variance / neurons))
    assert found.std() == pytest.approx(math.sqrt(variance), rel=0.1)


@given(durations, st.floats(-5.0, 5.0), st.floats(1e-3, 1.0))
def test_the_leaky_integrator_is_exact_whatever_the_steps(lengths, target, tau_s):
    filtered, now_s = LeakyIntegrator(1.0, tau_s), 0.0
    for length in lengths:
        now_s += length
        found = filtered.update(target, now_s)
    expected = target + (1.0 - target) * math.exp(-now_s / tau_s)
    assert float(found) == pytest.approx(expected, abs=1e-9)


def test_a_filter_has_not_drifted_after_hours_of_small_steps():
    """A spike at the very end counts in full."""
    decoder, tau_s = ExponentialRate(1, 0.05, start_s=3400.0), 0.05
    for step in range(170_001, 180_000):
        decoder.update(NOTHING, step * 20_000_000 / 1e9)
    last = Spikes(np.zeros(1, dtype=np.int64), np.array([3600.0]))
    assert decoder.update(last, 3600.0)[0] == 1.0 / tau_s


@pytest.mark.parametrize("decoder", [WindowRate(2, 0.1), ExponentialRate(2, 0.1)])
@pytest.mark.parametrize(
    ("neuron", "time_s", "until_s", "complaint"),
    [
        (0, 0.7, 0.6, "do not belong to the step"),
        (2, 0.55, 0.6, "a spike of neuron 2 in a population of 2"),
        (-1, 0.55, 0.6, "a spike of neuron -1 in a population of 2"),
        (0, 0.05, 0.1, "time goes back, from 0.5 s to 0.1 s"),
    ],
)
def test_spikes_that_cannot_be_are_refused(decoder, neuron, time_s, until_s, complaint):
    decoder.update(NOTHING, 0.5)
    with pytest.raises(ValueError, match=complaint):
        decoder.update(Spikes(np.array([neuron]), np.array([time_s])), until_s)


@pytest.mark.parametrize(
    ("rates", "duration_s", "complaint"),
    [
        ([1.0, -2.0], 1.0, "rate of neuron 1 is -2.0 Hz"),
        ([math.nan, 1.0], 1.0, "rate of neuron 0 is nan Hz"),
        ([[1.0, 2.0]], 1.0, "shape"),
        ([1.0, 2.0], 0.0, "duration_s must be above 0"),
        ([1.0, 2.0], math.inf, "duration_s must be above 0"),
    ],
)
def test_what_cannot_be_encoded_is_refused(rates, duration_s, complaint):
    with pytest.raises(ValueError, match=complaint):
        poisson_spikes(rates, duration_s, generator())
    with pytest.raises(ValueError, match=complaint):
        RegularEncoder(2).encode(rates, duration_s)


def test_indices_and_times_must_match():
    with pytest.raises(ValueError, match="one time per neuron index"):
        Spikes(np.array([0, 1]), np.array([0.1]))


def test_another_shape_than_before_is_refused_by_the_leaky_integrator():
    with pytest.raises(ValueError, match=r"shape \(3,\), not \(2,\)"):
        LeakyIntegrator([0.0, 0.0], 0.1).update([1.0, 2.0, 3.0], 0.1)
