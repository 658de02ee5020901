"""The tools around NEST, with NEST. It has one kernel per process: each test resets it."""

from __future__ import annotations

import math
import os
import warnings

import numpy as np
import pytest

pytest.importorskip("nest")

from neuros.errors import NodeError
from neuros.snn import (
    PartialDelayWarning,
    RateInput,
    RegularEncoder,
    SpikeInput,
    SpikeReader,
    Spikes,
    Stepper,
    Weights,
    WindowRate,
    import_nest,
    poisson_spikes,
    reset_kernel,
)


def noisy_network(seed=1, threads=1, delay_ms=1.0):
    """20 neurons that fire by Poisson input and each other's spikes; stepper and reader."""
    nest = reset_kernel(seed, threads=threads)
    neurons = nest.Create("iaf_psc_alpha", 20)
    noise = RateInput(neurons, weight=10.0, delay_ms=delay_ms)
    noise.set_rates(np.full(20, 8000.0))
    nest.Connect(neurons, neurons, "all_to_all", {"weight": 2.0, "delay": delay_ms})
    stepper = Stepper()
    return stepper, SpikeReader(neurons, stepper, delay_ms)


def fired(seed=1, threads=1, steps_ms=(20.0,) * 20, reads=True):
    """All spikes of 400 ms as ``(time, neuron)``, read after every step, or once at the end."""
    stepper, reader = noisy_network(seed, threads)
    parts = []
    with stepper:
        for length_ms in steps_ms:
            stepper.advance_s(length_ms / 1000.0)
            if reads:
                parts.append(reader.read())
        parts.append(reader.read())
    assert stepper.time_ns == 400_000_000
    pairs = [pair for part in parts for pair in zip(part.time_s, part.neuron, strict=True)]
    return sorted((float(time_s), int(neuron)) for time_s, neuron in pairs)


@pytest.fixture(scope="module")
def reference():
    spikes = fired(steps_ms=(400.0,), reads=False)
    assert len(spikes) > 100
    return spikes


@pytest.mark.parametrize("steps_ms", [(20.0,) * 20, (1.0,) * 400, (7.0, 13.0, 380.0)])
@pytest.mark.parametrize("reads", [True, False])
def test_steps_of_whole_delays_give_the_spikes_of_one_long_step(reference, steps_ms, reads):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fired(steps_ms=steps_ms, reads=reads) == reference


def test_a_step_of_partial_delays_is_warned_of_since_it_changes_the_spikes(reference):
    with pytest.warns(PartialDelayWarning, match=r"0\.5 ms is not a whole number of 1 ms") as told:
        assert fired(steps_ms=(0.5,) * 800) != reference
    assert {warning.filename for warning in told} == {__file__}


def test_a_strict_stepper_refuses_partial_delays_and_simulates_nothing():
    nest = reset_kernel(1)
    nest.Connect(*nest.Create("parrot_neuron", 2), syn_spec={"delay": 1.0})
    stepper = Stepper(strict=True)
    with pytest.raises(ValueError, match="the shortest delay: 1 ms is"):
        stepper.advance_ns(500_000)
    assert nest.biological_time == stepper.time_ns == 0


@pytest.mark.parametrize("duration_s", [0.0, -0.02, 0.00005, 1 / 3])
def test_a_step_of_partial_resolutions_is_refused(duration_s):
    nest = reset_kernel(1)
    with Stepper() as stepper, pytest.raises(ValueError, match="not a whole number"):
        stepper.advance_s(duration_s)
    assert nest.biological_time == 0.0


def test_time_goes_on_from_where_the_kernel_is():
    nest = reset_kernel(1, resolution_ms=0.5)
    nest.Simulate(3.0)
    with Stepper() as stepper:
        assert (stepper.time_ns, stepper.steps, stepper.resolution_ns) == (3_000_000, 6, 500_000)
        stepper.advance_to_ns(10_000_000)
        assert stepper.time_s == 0.01
    assert nest.biological_time == 10.0
    nest.Simulate(1.0)  # the kernel is free again


def test_the_shortest_delay_is_that_of_the_network():
    nest = reset_kernel(1)
    neurons = nest.Create("iaf_psc_alpha", 2)
    stepper = Stepper()
    nest.Connect(neurons[0], neurons[1], syn_spec={"delay": 1.5})
    assert stepper.min_delay_ns == 1_500_000
    SpikeReader(neurons, stepper, delay_ms=2.0)
    with stepper:
        stepper.advance_ns(3_000_000)
        assert stepper.min_delay_ns == 1_500_000
        with pytest.warns(PartialDelayWarning, match="20 ms is not a whole number of 1.5 ms"):
            stepper.advance_s(0.02)


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_seed_and_threads_give_the_same_spikes(threads):
    if threads > len(os.sched_getaffinity(0)):
        pytest.skip(f"needs {threads} cores")
    assert fired(seed=3, threads=threads) == fired(seed=3, threads=threads)
    assert fired(seed=3, threads=threads) != fired(seed=4, threads=threads)


def test_the_same_seed_with_other_threads_gives_other_spikes(reference):
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("needs 2 cores")
    assert fired(threads=2) != reference


def test_more_threads_than_cores_are_warned_of():
    cores = len(os.sched_getaffinity(0))
    with pytest.warns(RuntimeWarning, match=f"{cores + 1} NEST threads on {cores} core"):
        reset_kernel(1, threads=cores + 1)


@pytest.mark.parametrize("seed", [0, -1, 2**32])
def test_a_seed_that_nest_does_not_take_is_refused(seed):
    with pytest.raises(ValueError, match="seeds from 1 to 4294967295"):
        reset_kernel(seed)


def test_a_second_network_in_the_process_is_told_to_the_first():
    first, _ = noisy_network()
    first.advance_s(0.02)
    second, reader = noisy_network()
    with pytest.raises(NodeError, match="there is one per process"):
        first.advance_s(0.02)
    first.close()  # leaves the kernel of the second alone
    second.advance_s(0.4)
    assert len(reader.read()) > 100
    second.close()


def test_a_closed_stepper_says_so():
    reset_kernel(1)
    stepper = Stepper()
    stepper.close()
    with pytest.raises(ValueError, match="closed"):
        stepper.advance_s(0.02)


def test_poisson_generators_have_the_rates_that_were_set_step_by_step():
    """Parrots repeat each spike; four rates, two of which change half-way."""
    neurons = 400
    nest = reset_kernel(2)
    parrots = nest.Create("parrot_neuron", neurons)
    source = RateInput(parrots, weight=1.0)
    with Stepper() as stepper:
        reader = SpikeReader(parrots, stepper)
        for rates in ((0.0, 20.0, 50.0, 100.0), (0.0, 80.0, 50.0, 10.0)):
            source.set_rates(np.repeat(rates, neurons // 4))
            stepper.advance_s(0.002)  # what is on its way across the delay still has the old rate
            reader.read()
            stepper.advance_s(1.0)
            counts = reader.read().counts(neurons).reshape(4, -1)
            for expected, found in zip(rates, counts.mean(axis=1), strict=True):
                assert found == pytest.approx(expected, abs=5 * math.sqrt(expected / 100))


@pytest.mark.parametrize("rates", [[1.0], [1.0, -1.0], [math.nan, 0.0]])
def test_rates_that_cannot_be_are_refused(rates):
    nest = reset_kernel(1)
    with pytest.raises(ValueError, match="rate"):
        RateInput(nest.Create("parrot_neuron", 2), 1.0).set_rates(rates)


@pytest.mark.parametrize("coder", ["poisson", "regular"])
def test_a_coders_spikes_go_through_nest_unchanged(coder):
    """Into parrots and out again: each is there, later by the delay and by less than a step."""
    nest = reset_kernel(1)
    parrots = nest.Create("parrot_neuron", 10)
    rng, rates = np.random.default_rng(4), np.linspace(0.0, 300.0, 10)
    regular, sent, received = RegularEncoder(10, rng), [], []
    with Stepper() as stepper:
        source, reader = SpikeInput(parrots, stepper, 1.0), SpikeReader(parrots, stepper)
        for _ in range(20):
            start_s = stepper.time_s
            spikes = (
                poisson_spikes(rates, 0.02, rng, start_s)
                if coder == "poisson"
                else regular.encode(rates, 0.02, start_s)
            )
            source.play(spikes)
            stepper.advance_s(0.02)
            sent.append(spikes)
            received.append(reader.read())
        source.play(Spikes(np.zeros(0, dtype=np.int64), np.zeros(0)))
        stepper.advance_s(0.002)
        received.append(reader.read())
    for neuron in range(10):
        before, after = (
            np.sort(np.concatenate([part.time_s[part.neuron == neuron] for part in parts]))
            for parts in (sent, received)
        )
        assert after.size == before.size
        late_s = after - before - 0.001
        assert np.all((late_s >= -1e-9) & (late_s < 0.0001 + 1e-9))


def test_a_spike_of_the_past_cannot_be_played():
    nest = reset_kernel(1)
    with Stepper() as stepper:
        source = SpikeInput(nest.Create("parrot_neuron", 1), stepper, 1.0)
        stepper.advance_s(0.02)
        with pytest.raises(ValueError, match=r"a spike at 0\.015 s: the network is at 0\.02"):
            source.play(Spikes(np.array([0]), np.array([0.015])))


def test_a_reader_gives_each_spike_once_and_the_decoder_takes_them():
    stepper, reader = noisy_network()
    decoder, total = WindowRate(20, 0.4), 0
    with stepper:
        for _ in range(20):
            stepper.advance_s(0.02)
            spikes = reader.read()
            assert len(reader.read()) == 0
            total += len(spikes)
            rates = decoder.update(spikes, stepper.time_s)
    assert rates.sum() * 0.4 == pytest.approx(total)
    assert total > 100


def test_a_readers_indices_are_those_of_the_collection():
    nest = reset_kernel(1)
    nest.Create("iaf_psc_alpha", 3)
    neurons = nest.Create("parrot_neuron", 2) + nest.Create("parrot_neuron", 3)[1:]
    with Stepper() as stepper:
        source, reader = SpikeInput(neurons, stepper, 1.0), SpikeReader(neurons, stepper)
        source.play(Spikes(np.array([3, 0, 2]), np.array([0.001, 0.002, 0.003])))
        stepper.advance_s(0.02)
        found = reader.read().in_order()
    assert found.neuron.tolist() == [3, 0, 2]
    assert found.time_s.tolist() == pytest.approx([0.002, 0.003, 0.004])


def test_weights_come_back_in_their_places():
    nest = reset_kernel(1)
    sources, targets = nest.Create("parrot_neuron", 3), nest.Create("iaf_psc_alpha", 2)
    nest.Connect(targets, sources)
    for number in (2, 0, 1):
        nest.Connect(sources[number], targets)
    weights = Weights(sources, targets)
    given = np.arange(6.0).reshape(3, 2)
    weights.write(given)
    assert np.array_equal(weights.read(), given)
    for row, column in np.ndindex(3, 2):
        (own,) = nest.GetConnections(sources[row], targets[column])
        assert own.weight == given[row, column]
    with pytest.raises(ValueError, match=r"shape \(6,\), not \(3, 2\)"):
        weights.write(given.ravel())


def test_weights_need_a_synapse_from_each_to_each():
    nest = reset_kernel(1)
    neurons = nest.Create("parrot_neuron", 3)
    nest.Connect(neurons, neurons, "one_to_one")
    with pytest.raises(ValueError, match="3 synapses from 3 neurons to 3"):
        Weights(neurons, neurons)


def test_nest_is_imported_quietly_with_its_threads_fixed():
    assert import_nest().__name__ == "nest"
    assert os.environ["OMP_NUM_THREADS"]
