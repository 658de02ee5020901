"""The double ring in NEST: a spiking network that integrates a yaw rate into a heading.

No ROS and no node in here. NEST has one kernel per process: one network per process at a time.
NEST is imported with the first network.
"""

from __future__ import annotations

from typing import Any

import double_ring as ring
import numpy as np
from double_ring import DELAY_MS, NEURONS_PER_RING, PREFERRED_RAD, ROTATION_RAD, DoubleRing

from neuros.snn import SpikeReader, Spikes, Stepper, reset_kernel

DRIVE_PA_PER_RAD_S = 29.9
"""Tuned: the bump follows a turn at its own speed."""
RESOLUTION_MS = 0.1


class HeadDirectionNetwork(DoubleRing):
    """The ring that :class:`~double_ring.DoubleRing` describes.

    Args:
        seed: of the initial membrane potentials, the only randomness; 1 to 2**32 - 1.
        beside: a network in whose kernel this one is created, with equal potentials. Settle and
            step that one: both go on together, and only :meth:`correct` and ``offset_rad_s`` make a
            difference.

    Attributes:
        offset_rad_s: is added to each rate of :meth:`step`, for this network alone.

    Deterministic: the same seed and the same steps give the same headings, bit for bit.
    """

    def __init__(self, seed: int = 1, beside: HeadDirectionNetwork | None = None) -> None:
        super().__init__()
        nest = beside._nest if beside else reset_kernel(seed, resolution_ms=RESOLUTION_MS)
        self._nest = nest
        self._left, self._right = self._ring(), self._ring()
        for neurons, rotation in ((self._left, ROTATION_RAD), (self._right, -ROTATION_RAD)):
            self._connect(neurons, rotation)
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
        self._rate_rad_s = self.offset_rad_s = 0.0

    @property
    def quantum_s(self) -> float:
        """Steps must last a whole number of these: other lengths change the spikes."""
        return self._stepper.min_delay_ns * 1e-9

    def correct(self, heading_rad: float, peak_pa: float, width_rad: float) -> None:
        """Pull the bump towards a heading, from here on: a Gaussian current into both rings.

        A peak of 0 lets it go.
        """
        if self._correction is None:
            if peak_pa == 0.0:
                return
            self._stepper.release()
            self._correction = self._nest.Create("dc_generator", NEURONS_PER_RING)
            for neurons in (self._left, self._right):
                self._nest.Connect(self._correction, neurons, "one_to_one", {"delay": DELAY_MS})
        away_rad = np.angle(np.exp(1j * (PREFERRED_RAD - self._zero_rad - heading_rad)))
        self._correction.amplitude = peak_pa * np.exp(-0.5 * (away_rad / width_rad) ** 2)

    def _set_drive(self, rate_rad_s: float) -> None:
        rate_rad_s += self.offset_rad_s
        if rate_rad_s != self._rate_rad_s:
            self._drive_left.amplitude = DRIVE_PA_PER_RAD_S * rate_rad_s
            self._drive_right.amplitude = -DRIVE_PA_PER_RAD_S * rate_rad_s
            self._rate_rad_s = rate_rad_s

    def _advance(self, duration_s: float) -> None:
        self._stepper.advance_s(duration_s)

    def _read(self) -> Spikes:
        return self._reader.read()

    def _stepped_together(self) -> list[HeadDirectionNetwork]:
        return self._together

    def _ring(self) -> Any:
        return self._nest.Create(
            "iaf_psc_alpha",
            NEURONS_PER_RING,
            params={
                "C_m": ring.CAPACITANCE_PF,
                "tau_m": ring.TAU_MEMBRANE_MS,
                "t_ref": ring.REFRACTORY_MS,
                "E_L": ring.REST_MV,
                "V_reset": ring.RESET_MV,
                "V_th": ring.THRESHOLD_MV,
                "tau_syn_ex": ring.TAU_SYNAPSE_MS,
                "tau_syn_in": ring.TAU_SYNAPSE_MS,
                "I_e": ring.BACKGROUND_PA,
                "V_m": self._nest.random.uniform(ring.RESET_MV, ring.THRESHOLD_MV),
            },
        )

    def _connect(self, senders: Any, rotation_rad: float) -> None:
        """Connect one ring to both, leaving weights of zero out (they cost time for nothing)."""
        weights = ring.weights_pa(rotation_rad)
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
        generators = self._nest.Create(
            "dc_generator",
            NEURONS_PER_RING,
            params={
                "amplitude": ring.initial_bump_pa(),
                "stop": self._nest.biological_time + ring.INITIAL_BUMP_MS,
            },
        )
        for neurons in (self._left, self._right):
            self._nest.Connect(generators, neurons, "one_to_one", {"delay": DELAY_MS})
