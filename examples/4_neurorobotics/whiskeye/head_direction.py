"""A spiking head-direction network: two rings of neurons that hold, and turn, one bump of activity.

Double ring after Xie, Hahnloser & Seung, "Double-ring network model of the head-direction system",
Phys. Rev. E 66, 041902 (2002), in spiking neurons. Every neuron has a preferred heading. All
synapses are inhibitory, weakest about the preferred heading of the sender, so a bump of activity
inhibits everything but itself and stays where it is. The synapses of ring L are rotated by +phi,
those of ring R by -phi: each ring alone would push the bump, together they are in balance. A turn
raises the current into one ring and lowers it in the other by the same amount; the bump moves at a
speed proportional to the difference, to either side.

No ROS and no node in here. NEST has one kernel per process: one network per process at a time.
NEST is imported with the first network.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from neuros.snn import PopulationVector, SpikeReader, Spikes, Stepper, reset_kernel

NEURONS_PER_RING = 120
TAU_SYNAPSE_MS = 50.0
BACKGROUND_PA = 1000.0
INHIBITION_PA_PER_HZ = 24.0  # J0
MODULATION_PA_PER_HZ = 20.0  # J1
ROTATION_RAD = math.radians(45.0)  # phi
DRIVE_PA_PER_RAD_S = 29.9
RESOLUTION_MS = 0.1
DELAY_MS = 1.0
INITIAL_BUMP_PA = 150.0
INITIAL_BUMP_MS = 200.0
SETTLE_WINDOW_S = 0.02


class HeadDirectionNetwork:
    """Integrates a yaw rate into a heading.

    Args:
        seed: of the initial membrane potentials, the only randomness; 1 to 2**32 - 1.
        beside: a network in whose kernel this one is created, with equal potentials. Settle and
            step that one: both go on together, and only :meth:`correct` and ``offset_rad_s`` make a
            difference.

    Attributes:
        offset_rad_s: is added to each rate of :meth:`step`, for this network alone.

    The heading starts at zero, which is what is decoded at the end of :meth:`settle`.
    Deterministic: the same seed and the same steps give the same headings, bit for bit.
    """

    def __init__(self, seed: int = 1, beside: HeadDirectionNetwork | None = None) -> None:
        nest = beside._nest if beside else reset_kernel(seed, resolution_ms=RESOLUTION_MS)
        self._nest = nest
        self._angles = 2.0 * np.pi * (np.arange(NEURONS_PER_RING) + 0.5) / NEURONS_PER_RING
        self._left, self._right = self._ring(), self._ring()
        for ring, rotation in ((self._left, ROTATION_RAD), (self._right, -ROTATION_RAD)):
            self._connect(ring, rotation)
        self._drive_left, self._drive_right = nest.Create("dc_generator", 2)
        nest.Connect(self._drive_left, self._left, syn_spec={"delay": DELAY_MS})
        nest.Connect(self._drive_right, self._right, syn_spec={"delay": DELAY_MS})
        self._stepper = beside._stepper if beside else Stepper(strict=True)
        self._together = [self]
        if beside:
            beside._together.append(self)
            self._left.V_m, self._right.V_m = beside._left.V_m, beside._right.V_m
        self._correction: Any = None  # made when it is needed: it costs time
        self._reader = SpikeReader(self._left + self._right, self._stepper, DELAY_MS)
        self._population = PopulationVector(np.tile(self._angles, 2))
        self._raw_rad = self._zero_rad = self._heading_rad = 0.0
        self._rate_rad_s = self.offset_rad_s = 0.0

    @property
    def heading_rad(self) -> float:
        """The last heading, in (-pi, pi], counter-clockwise positive."""
        return self._heading_rad

    @property
    def quantum_s(self) -> float:
        """Steps must last a whole number of these: other lengths change the spikes."""
        return self._stepper.min_delay_ns * 1e-9

    def settle(self, duration_s: float = 1.5) -> float:
        """Start the bump and let it come to rest; what is decoded at the end becomes heading zero.

        Takes ``duration_s`` of the network's time, at least 1 s. Returns the heading, 0. One 20 ms
        window scatters by 1 to 2 degrees, so the end is the mean over the last half second.
        """
        windows = round(duration_s / SETTLE_WINDOW_S)
        if duration_s < 1.0:
            raise ValueError(f"settling for {duration_s!r} s is too short: the bump needs 1 s")
        for network in self._together:
            network._start_bump()
        decoded = []
        for _ in range(windows):
            self.step(0.0, SETTLE_WINDOW_S)
            decoded.append([network._raw_rad for network in self._together])
        zeros_rad = np.angle(np.exp(1j * np.array(decoded[-25:])).sum(axis=0))
        for network, zero_rad in zip(self._together, zeros_rad, strict=True):
            network._zero_rad, network._heading_rad = float(zero_rad), 0.0
        return self._heading_rad

    def step(self, rate_rad_s: float, duration_s: float) -> float:
        """Turn at ``rate_rad_s`` for ``duration_s``; returns the heading decoded over that time.

        Raises ``ValueError`` where the duration is not a whole number of :attr:`quantum_s`.
        """
        for network in self._together:
            network._set_drive(rate_rad_s + network.offset_rad_s)
        self._stepper.advance_s(duration_s)
        for network in self._together:
            network._decode(network._reader.read())
        return self._heading_rad

    def correct(self, heading_rad: float, peak_pa: float, width_rad: float) -> None:
        """Pull the bump towards a heading, from here on: a Gaussian current into both rings.

        A peak of 0 lets it go.
        """
        if self._correction is None:
            if peak_pa == 0.0:
                return
            self._stepper.release()
            self._correction = self._nest.Create("dc_generator", NEURONS_PER_RING)
            for ring in (self._left, self._right):
                self._nest.Connect(self._correction, ring, "one_to_one", {"delay": DELAY_MS})
        away_rad = np.angle(np.exp(1j * (self._angles - self._zero_rad - heading_rad)))
        self._correction.amplitude = peak_pa * np.exp(-0.5 * (away_rad / width_rad) ** 2)

    def _set_drive(self, rate_rad_s: float) -> None:
        if rate_rad_s != self._rate_rad_s:
            self._drive_left.amplitude = DRIVE_PA_PER_RAD_S * rate_rad_s
            self._drive_right.amplitude = -DRIVE_PA_PER_RAD_S * rate_rad_s
            self._rate_rad_s = rate_rad_s

    def _decode(self, spikes: Spikes) -> None:
        """Population vector over the spikes of the last step; without spikes the heading stays."""
        decoded_rad = self._population.of_spikes(spikes).angle_rad
        if math.isnan(decoded_rad):
            return
        self._raw_rad = decoded_rad
        turned = self._raw_rad - self._zero_rad
        self._heading_rad = math.atan2(math.sin(turned), math.cos(turned))

    def _ring(self) -> Any:
        return self._nest.Create(
            "iaf_psc_alpha",
            NEURONS_PER_RING,
            params={
                "C_m": 250.0,
                "tau_m": 10.0,
                "t_ref": 2.0,
                "E_L": -70.0,
                "V_reset": -70.0,
                "V_th": -55.0,
                "tau_syn_ex": TAU_SYNAPSE_MS,
                "tau_syn_in": TAU_SYNAPSE_MS,
                "I_e": BACKGROUND_PA,
                "V_m": self._nest.random.uniform(-70.0, -55.0),
            },
        )

    def _connect(self, senders: Any, rotation_rad: float) -> None:
        """Connect one ring to both, leaving weights of zero out (they cost time for nothing)."""
        angles = self._angles
        cosine = np.cos(angles[:, None] - angles[None, :] - rotation_rad)  # (receiver, sender)
        per_hz = -INHIBITION_PA_PER_HZ + MODULATION_PA_PER_HZ * cosine
        # An alpha synapse of peak w carries w * e * tau of charge per spike, so the mean current at
        # 1 Hz is w * e * tau / 1000 pA; the sum over 2 N senders is a mean over headings.
        weights = 1000.0 / (math.e * TAU_SYNAPSE_MS * 2 * NEURONS_PER_RING) * per_hz
        ids = np.array(senders.tolist())
        for receivers in (self._left, self._right):
            post, pre = np.nonzero(weights)
            self._nest.Connect(
                ids[pre],
                np.array(receivers.tolist())[post],
                "one_to_one",
                {"weight": weights[post, pre], "delay": np.full(post.size, DELAY_MS)},
            )

    def _start_bump(self) -> None:
        """A current with one maximum, for a moment, breaks the symmetry of the ring."""
        generators = self._nest.Create(
            "dc_generator",
            NEURONS_PER_RING,
            params={
                "amplitude": INITIAL_BUMP_PA * np.cos(self._angles - np.pi),
                "stop": self._nest.biological_time + INITIAL_BUMP_MS,
            },
        )
        for ring in (self._left, self._right):
            self._nest.Connect(generators, ring, "one_to_one", {"delay": DELAY_MS})
