"""The double ring as numbers and as an interface, for whichever simulator it runs in.

Two rings of neurons hold, and turn, one bump of activity. After Xie, Hahnloser & Seung,
"Double-ring network model of the head-direction system", Phys. Rev. E 66, 041902 (2002), in spiking
neurons. Every neuron has a preferred heading. All synapses are inhibitory, weakest about the
preferred heading of the sender, so a bump of activity inhibits everything but itself and stays
where it is. The synapses of ring L are rotated by +phi, those of ring R by -phi: each ring alone
would push the bump, together they are in balance. A turn raises the current into one ring and
lowers it in the other by the same amount; the bump moves at a speed proportional to the difference,
to either side.

No ROS, no node and no simulator in here: ``head_direction.py`` builds it in NEST, ``nengo_ring.py``
in Nengo.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from neuros.snn import PopulationVector, Spikes
from neuros.snn.coding import Floats, Indices

NEURONS_PER_RING = 120
CAPACITANCE_PF = 250.0
TAU_MEMBRANE_MS = 10.0
REFRACTORY_MS = 2.0
REST_MV = RESET_MV = -70.0
THRESHOLD_MV = -55.0
TAU_SYNAPSE_MS = 50.0  # of an alpha function: a current
DELAY_MS = 1.0
BACKGROUND_PA = 1000.0
INHIBITION_PA_PER_HZ = 24.0  # J0
MODULATION_PA_PER_HZ = 20.0  # J1
ROTATION_RAD = math.radians(45.0)  # phi
INITIAL_BUMP_PA = 150.0
INITIAL_BUMP_MS = 200.0
SETTLE_WINDOW_S = 0.02

PREFERRED_RAD = 2.0 * np.pi * (np.arange(NEURONS_PER_RING) + 0.5) / NEURONS_PER_RING
"""Of the neurons of either ring, ``(N,)``."""


def weights_pa(rotation_rad: float) -> Floats:
    """Peak currents from one ring to either, ``(receiver, sender)``, each N; none is above 0.

    Args:
        rotation_rad: of the sending ring; ``ROTATION_RAD`` for L, the opposite for R.
    """
    cosine = np.cos(PREFERRED_RAD[:, None] - PREFERRED_RAD[None, :] - rotation_rad)
    per_hz = -INHIBITION_PA_PER_HZ + MODULATION_PA_PER_HZ * cosine
    # An alpha synapse of peak w carries w * e * tau of charge per spike, so the mean current at
    # 1 Hz is w * e * tau / 1000 pA; the sum over 2 N senders is a mean over headings.
    return 1000.0 / (math.e * TAU_SYNAPSE_MS * 2 * NEURONS_PER_RING) * per_hz


def initial_bump_pa() -> Floats:
    """What breaks the symmetry of a ring: a current with one maximum, ``(N,)``."""
    return INITIAL_BUMP_PA * np.cos(PREFERRED_RAD - np.pi)


class DoubleRing(ABC):
    """Integrates a yaw rate into a heading, which starts at zero at the end of :meth:`settle`."""

    def __init__(self) -> None:
        self._population = PopulationVector(np.tile(PREFERRED_RAD, 2))
        self._raw_rad = self._zero_rad = self._heading_rad = 0.0
        self._spikes = Spikes(np.empty(0, np.int64), np.empty(0))

    @property
    def heading_rad(self) -> float:
        """The last heading, in (-pi, pi], counter-clockwise positive."""
        return self._heading_rad

    @property
    def activity(self) -> Indices:
        """Spikes of the last step, of both rings, by preferred heading, ``(N,)``: the bump."""
        spikes = np.bincount(self._spikes.neuron, minlength=2 * NEURONS_PER_RING)
        return spikes.reshape(2, NEURONS_PER_RING).sum(axis=0)

    @property
    @abstractmethod
    def quantum_s(self) -> float:
        """Steps must last a whole number of these."""

    def settle(self, duration_s: float = 1.5) -> float:
        """Start the bump and let it come to rest; what is decoded at the end becomes heading zero.

        Takes ``duration_s`` of the network's time, at least 1 s. Returns the heading, 0. One 20 ms
        window scatters by 1 to 2 degrees, so the end is the mean over the last half second.
        """
        windows = round(duration_s / SETTLE_WINDOW_S)
        if duration_s < 1.0:
            raise ValueError(f"settling for {duration_s!r} s is too short: the bump needs 1 s")
        rings = self._stepped_together()
        for ring in rings:
            ring._start_bump()
        decoded = []
        for _ in range(windows):
            self.step(0.0, SETTLE_WINDOW_S)
            decoded.append([ring._raw_rad for ring in rings])
        zeros_rad = np.angle(np.exp(1j * np.array(decoded[-25:])).sum(axis=0))
        for ring, zero_rad in zip(rings, zeros_rad, strict=True):
            ring._zero_rad, ring._heading_rad = float(zero_rad), 0.0
        return self._heading_rad

    def call_heading(self, heading_rad: float) -> None:
        """Call that heading where the bump is now. The bump stays."""
        self._zero_rad += self._heading_rad - heading_rad
        self._heading_rad = math.remainder(heading_rad, math.tau)

    def step(self, rate_rad_s: float, duration_s: float) -> float:
        """Turn at ``rate_rad_s`` for ``duration_s``; returns the heading decoded over that time.

        Raises ``ValueError`` where the duration is not a whole number of :attr:`quantum_s`.
        """
        rings = self._stepped_together()
        for ring in rings:
            ring._set_drive(rate_rad_s)
        self._advance(duration_s)
        for ring in rings:
            ring._decode(ring._read())
        return self._heading_rad

    def _decode(self, spikes: Spikes) -> None:
        """Population vector over the spikes of the last step; without spikes the heading stays."""
        self._spikes = spikes
        decoded_rad = self._population.of_spikes(spikes).angle_rad
        if math.isnan(decoded_rad):
            return
        self._raw_rad = decoded_rad
        turned = self._raw_rad - self._zero_rad
        self._heading_rad = math.atan2(math.sin(turned), math.cos(turned))

    def _stepped_together(self) -> Sequence[DoubleRing]:
        """All that :meth:`step` advances: this one, and those that share its simulation."""
        return (self,)

    @abstractmethod
    def _start_bump(self) -> None:
        """Give :func:`initial_bump_pa` to both rings, for ``INITIAL_BUMP_MS`` from now on."""

    @abstractmethod
    def _set_drive(self, rate_rad_s: float) -> None:
        """Drive the rings apart, from now on."""

    @abstractmethod
    def _advance(self, duration_s: float) -> None:
        """Simulate."""

    @abstractmethod
    def _read(self) -> Spikes:
        """The spikes of both rings since the last call; neurons 0 to N - 1 are those of L."""
