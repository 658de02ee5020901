"""The double ring in Nengo: the same neurons, currents and weights as in ``head_direction.py``.

Nengo has no units: a neuron fires where its voltage, 0 at rest, passes 1, and input currents are in
what it takes to get there. It finds when within a step a spike falls, so that steps may be longer;
one step of 1 ms is also the delay of its connections. No ROS and no node in here.
"""

from __future__ import annotations

import math

import double_ring as ring
import nengo
import numpy as np
from double_ring import NEURONS_PER_RING, ROTATION_RAD, DoubleRing
from nengo.builder import Model
from nengo.cache import NoDecoderCache

from neuros.snn import Spikes
from neuros.snn.coding import Floats
from neuros.snn.nest import StepGrid, nanoseconds, nanoseconds_of_ms

DRIVE_PA_PER_RAD_S = 29.5
"""Tuned: the bump follows a turn at its own speed. With NEST's 29.9 it turns 1.4 % too far."""
PER_PA = ring.TAU_MEMBRANE_MS / ring.CAPACITANCE_PF / (ring.THRESHOLD_MV - ring.REST_MV)
"""Of the way from rest to threshold, per pA; ms / pF is GOhm, and GOhm pA is mV."""


class NengoRing(DoubleRing):
    """The ring that :class:`~double_ring.DoubleRing` describes.

    Args:
        seed: of the initial membrane potentials, the only randomness; 0 to 2**31 - 1.

    Deterministic: the same seed and the same steps give the same headings, on one kind of
    processor bit for bit.
    """

    def __init__(self, seed: int = 1) -> None:
        super().__init__()
        step_ns = nanoseconds_of_ms(ring.DELAY_MS)
        self._grid = StepGrid(step_ns, step_ns)
        self._drive_pa, self._bump_pa = np.zeros((2, 2 * NEURONS_PER_RING))
        self._bump_until_s = 0.0
        self._fired: list[tuple[float, Floats]] = []
        # Connections between neurons have no decoders: nothing is to be kept in the home folder.
        model = Model(dt=step_ns * 1e-9, decoder_cache=NoDecoderCache())
        network = self._network(seed)
        self._simulator = nengo.Simulator(network, dt=model.dt, model=model, progress_bar=False)

    @property
    def quantum_s(self) -> float:
        """Nengo's step."""
        return self._grid.resolution_ns * 1e-9

    def _network(self, seed: int) -> nengo.Network:
        neurons = nengo.LIF(
            tau_rc=ring.TAU_MEMBRANE_MS * 1e-3,
            tau_ref=ring.REFRACTORY_MS * 1e-3,
            min_voltage=-math.inf,
            initial_state={"voltage": nengo.dists.Uniform(0.0, 1.0)},
        )
        # Nengo's alpha function has an area of 1: that of one with a peak of 1 is e * tau.
        area_s = math.e * ring.TAU_SYNAPSE_MS * 1e-3
        of_left, of_right = (ring.weights_pa(each) for each in (ROTATION_RAD, -ROTATION_RAD))
        weights_pa = np.tile(np.hstack([of_left, of_right]), (2, 1))  # (receiver, sender)
        with nengo.Network(seed=seed) as network:
            rings = nengo.Ensemble(
                2 * NEURONS_PER_RING,
                dimensions=1,
                neuron_type=neurons,
                gain=nengo.dists.Choice([1.0]),
                bias=nengo.dists.Choice([ring.BACKGROUND_PA * PER_PA]),
            )
            nengo.Connection(
                rings.neurons,
                rings.neurons,
                transform=weights_pa * area_s * PER_PA,
                synapse=nengo.Alpha(ring.TAU_SYNAPSE_MS * 1e-3),
            )
            current = nengo.Node(self._current_pa, size_out=2 * NEURONS_PER_RING)
            nengo.Connection(current, rings.neurons, transform=PER_PA, synapse=None)
            recorder = nengo.Node(self._record, size_in=2 * NEURONS_PER_RING)
            nengo.Connection(rings.neurons, recorder, synapse=None)
        return network

    def _current_pa(self, time_s: float) -> Floats:
        return self._drive_pa + (self._bump_pa if time_s <= self._bump_until_s else 0.0)

    def _record(self, time_s: float, output: Floats) -> None:
        self._fired.append((time_s, np.flatnonzero(output)))

    def _start_bump(self) -> None:
        self._bump_pa = np.tile(ring.initial_bump_pa(), 2)
        self._bump_until_s = self._simulator.time + ring.INITIAL_BUMP_MS * 1e-3

    def _set_drive(self, rate_rad_s: float) -> None:
        drive_pa = DRIVE_PA_PER_RAD_S * rate_rad_s
        self._drive_pa = np.repeat([drive_pa, -drive_pa], NEURONS_PER_RING)

    def _advance(self, duration_s: float) -> None:
        self._simulator.run_steps(self._grid.steps(nanoseconds(duration_s)), progress_bar=False)

    def _read(self) -> Spikes:
        fired, self._fired = self._fired, []
        times_s = [np.full(neurons.size, time_s) for time_s, neurons in fired]
        return Spikes(np.concatenate([each for _, each in fired]), np.concatenate(times_s))
