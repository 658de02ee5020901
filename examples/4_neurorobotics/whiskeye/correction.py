"""The ring that vision corrects, beside the ring alone: one kernel, one gyroscope.

A heading that was seen is some time old when it arrives. It is turned with the gyroscope up to now,
and a little further, for the ring follows its input late; that is where the current pulls the bump.
Held still between two pictures, it would drag the bump back by some 10 degrees at 1 rad/s.
"""

from __future__ import annotations

import math
from collections import deque

from head_direction import HeadDirectionNetwork
from snn import GyroIntegrator

HOLD_NS = 300_000_000  # how long a heading that was seen is good for: three pictures
LEAD_S = 0.06  # how late the ring follows
WIDTH_RAD = math.radians(30.0)
GATE = 0.12  # see README.md


class SeenHeading:
    """Where vision says the head points: turned on with the gyroscope, and gated.

    Args:
        gate: mean squared error of the predicted view, above which a heading is not believed.
    """

    def __init__(self, gate: float = GATE) -> None:
        self._gate = gate
        self._turned = deque([(0, 0.0)])  # (stamp in ns, what the gyroscope has turned until then)
        self._seen: tuple[int, float] | None = None

    def turn(self, stamp_ns: int, rate_rad_s: float) -> None:
        """The gyroscope said so, for the time since the stamp before."""
        before_ns, turned_rad = self._turned[-1]
        self._turned.append((stamp_ns, turned_rad + rate_rad_s * (stamp_ns - before_ns) * 1e-9))
        while self._turned[0][0] < stamp_ns - 2 * HOLD_NS:
            self._turned.popleft()

    def see(self, stamp_ns: int, heading_rad: float, error: float) -> None:
        """Vision said so, of a picture of that stamp. NaN: there was no picture."""
        if not math.isnan(heading_rad):
            self._seen = (stamp_ns, heading_rad) if error <= self._gate else None

    def target_rad(self, rate_rad_s: float) -> float | None:
        """The heading to pull to now; ``None`` without one that is new enough and believed."""
        now_ns, turned_rad = self._turned[-1]
        if self._seen is None or now_ns - self._seen[0] > HOLD_NS:
            return None
        stamp_ns, heading_rad = self._seen
        then_rad = next((rad for ns, rad in self._turned if ns >= stamp_ns), turned_rad)
        return heading_rad + turned_rad - then_rad + rate_rad_s * LEAD_S


class CorrectedIntegrator:
    """Integrates the gyroscope with both rings, and pulls one of them to where vision says.

    Args:
        seed: of both rings.
        bias_rad_s: is added to the gyroscope.
        peak_pa: the gain: highest current of the correction, in pA; 0 corrects nothing.
        gate: see :class:`SeenHeading`.
    """

    def __init__(self, seed: int, bias_rad_s: float, peak_pa: float, gate: float) -> None:
        self.alone = HeadDirectionNetwork(seed)
        self.corrected = HeadDirectionNetwork(seed, beside=self.alone)
        self.alone.settle()
        self.vision = SeenHeading(gate)
        self._integrator = GyroIntegrator(self.alone, bias_rad_s)
        self._bias_rad_s, self._peak_pa = bias_rad_s, peak_pa

    def integrate(self, stamp_ns: int, rate_rad_s: float) -> tuple[float, float]:
        """Headings in rad at this stamp: of the ring that is corrected, and of the ring alone."""
        biased_rad_s = rate_rad_s + self._bias_rad_s
        self.vision.turn(stamp_ns, biased_rad_s)
        target_rad = self.vision.target_rad(biased_rad_s)
        if target_rad is None:
            self.corrected.correct(0.0, 0.0, WIDTH_RAD)
        else:
            # The rings have not simulated what was bridged: they are behind by as much.
            seen_rad = target_rad - self._integrator.bridged_rad
            self.corrected.correct(seen_rad, self._peak_pa, WIDTH_RAD)
        alone_rad = self._integrator.integrate(stamp_ns, rate_rad_s)
        corrected_rad = self.corrected.heading_rad + self._integrator.bridged_rad
        return math.remainder(corrected_rad, math.tau), alone_rad
