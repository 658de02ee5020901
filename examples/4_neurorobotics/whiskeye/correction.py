"""The ring that vision corrects, beside the ring alone: one kernel, one gyroscope.

A heading that was seen is some time old when it arrives. It is turned with the gyroscope up to now,
and a little further, for the ring follows its input late; that is where the current pulls the bump.
Held still between two pictures, it would drag the bump back by some 10 degrees at 1 rad/s.

How hard it pulls depends on how exact the heading is: by the inverse of its variance, as a Kalman
filter weighs what it measures. Else the ring would follow the worst views as closely as the best,
and one whose gyroscope is right would lose by what it sees.

A Gaussian current alone cannot move a bump that is 180 degrees off: it pulls to both sides alike,
and the inhibition of the bump keeps a second one from rising. So it grows with the square of how
far the ring has been off lately (:class:`Mismatch`), until a new bump rises where the heading is
seen and the old one ends. A single wrong view does not last long enough for that.

The bias of the gyroscope is learnt from what vision and the turned gyroscope differ by in the long
run, as in Mahony, Hamel & Pflimlin, *IEEE Transactions on Automatic Control* 53(5) (2008). From the
ring's own heading it would be learnt worse: the ring lags, and slips by some percent of its rate,
and the harder vision pulls it, the more of that would be taken for bias (up to 0.05 rad/s of 0.1).
"""

from __future__ import annotations

import math
from collections import deque

from head_direction import HeadDirectionNetwork
from snn import GyroIntegrator

HOLD_NS = 300_000_000  # how long a heading that was seen is good for: three pictures
LEAD_S = 0.06  # how late the ring follows: so far ahead a current holds the bump, no more
WIDTH_RAD = math.radians(30.0)
EXACT_RAD = math.radians(1.0)  # a heading as exact as this is pulled to with all of the gain
GATE = 0.12  # see README.md
MISMATCH_PER_S = 1.0  # how fast a mismatch is believed, by headings that are exact
INSISTING = 6.0
ASTRAY_RAD = math.radians(30.0)  # no bias of a gyroscope explains a heading that is so far off
FOLLOWS_PER_S = 2.0  # how fast the heading by gyroscope, from which the bias is learnt, is pulled


class SeenHeading:
    """Where vision says the head points: turned on with the gyroscope, weighed and gated.

    Args:
        gate: mean squared error of the predicted view, above which a heading is not believed.
    """

    def __init__(self, gate: float = GATE) -> None:
        self._gate = gate
        self._turned = deque([(0, 0.0)])  # (stamp in ns, what the gyroscope has turned until then)
        self._seen: tuple[int, float, float] | None = None

    def turn(self, stamp_ns: int, rate_rad_s: float) -> None:
        """The gyroscope said so, for the time since the stamp before."""
        before_ns, turned_rad = self._turned[-1]
        self._turned.append((stamp_ns, turned_rad + rate_rad_s * (stamp_ns - before_ns) * 1e-9))
        while self._turned[0][0] < stamp_ns - 2 * HOLD_NS:
            self._turned.popleft()

    def see(self, stamp_ns: int, heading_rad: float, error: float, deviation_rad: float) -> None:
        """Vision said so, of a picture of that stamp. NaN: there was no picture.

        Args:
            error: of the predicted view, mean squared.
            deviation_rad: how far the heading is off, as one standard deviation.
        """
        if not math.isnan(heading_rad):
            weight = (EXACT_RAD / max(deviation_rad, EXACT_RAD)) ** 2
            self._seen = (stamp_ns, heading_rad, weight) if error <= self._gate else None

    def now(self) -> tuple[float, float] | None:
        """Heading and its weight, 0 to 1; ``None`` without one that is new enough and believed."""
        now_ns, turned_rad = self._turned[-1]
        if self._seen is None or now_ns - self._seen[0] > HOLD_NS:
            return None
        stamp_ns, heading_rad, weight = self._seen
        then_rad = next((rad for ns, rad in self._turned if ns >= stamp_ns), turned_rad)
        return heading_rad + turned_rad - then_rad, weight


class Mismatch:
    """How far the ring has been off what was seen lately: 0 not at all, 1 by 180 degrees.

    A running mean of ``(1 - cos(difference)) / 2``, weighed like the headings that were seen: exact
    ones are believed after one second, others after longer. Without any it stays as it is.
    """

    def __init__(self) -> None:
        self.mean = 0.0

    def see(self, difference_rad: float, weight: float, passed_s: float) -> None:
        """The ring was off by so much for so long."""
        share = 1.0 - math.exp(-MISMATCH_PER_S * weight * passed_s)
        self.mean += share * ((1.0 - math.cos(difference_rad)) / 2.0 - self.mean)


class CorrectedIntegrator:
    """Integrates the gyroscope with both rings, and pulls one of them to where vision says.

    Args:
        seed: of both rings.
        bias_rad_s: is added to the gyroscope.
        peak_pa: the gain: highest current of the correction, in pA; 0 corrects nothing.
        gate: see :class:`SeenHeading`.
        learning_per_s2: how fast the gyroscope's bias is learnt from what vision and the turned
            gyroscope differ by, in rad/s per rad and second; 0: it is not.
        start_rad: what both rings call the heading at the start; 0 is right.
        insisting: how many times the gain is added where all of late was seen 180 degrees off.

    Attributes:
        learnt_rad_s: the bias that has been learnt; the corrected ring is driven without it.
    """

    def __init__(
        self,
        seed: int,
        bias_rad_s: float,
        peak_pa: float,
        gate: float,
        learning_per_s2: float = 0.0,
        start_rad: float = 0.0,
        insisting: float = INSISTING,
    ) -> None:
        self.alone = HeadDirectionNetwork(seed)
        self.corrected = HeadDirectionNetwork(seed, beside=self.alone)
        self.alone.settle()
        for ring in (self.alone, self.corrected):
            ring.call_heading(start_rad)
        self._mismatch, self._insisting = Mismatch(), insisting
        self.vision = SeenHeading(gate)
        self._integrator = GyroIntegrator(self.alone, bias_rad_s)
        self._bias_rad_s, self._peak_pa = bias_rad_s, peak_pa
        self._learning_per_s2 = learning_per_s2
        self.learnt_rad_s = 0.0
        self._bridged_rad, self._done_ns = 0.0, 0
        self._by_gyroscope_rad = math.nan  # unknown until a heading was seen

    def integrate(self, stamp_ns: int, rate_rad_s: float) -> tuple[float, float]:
        """Headings in rad at this stamp: of the ring that is corrected, and of the ring alone."""
        corrected_rad_s = rate_rad_s + self._bias_rad_s - self.learnt_rad_s
        self.vision.turn(stamp_ns, corrected_rad_s)
        seen = self.vision.now()
        if seen is None:
            self.corrected.correct(0.0, 0.0, WIDTH_RAD)
        else:
            # The rings have not simulated what was bridged: they are behind by as much.
            target_rad = seen[0] + corrected_rad_s * LEAD_S - self._bridged_rad
            off_rad = self.corrected.heading_rad - target_rad
            self._mismatch.see(off_rad, seen[1], (stamp_ns - self._done_ns) * 1e-9)
            gain = seen[1] + self._insisting * self._mismatch.mean**2
            self.corrected.correct(target_rad, self._peak_pa * gain, WIDTH_RAD)
        self.corrected.offset_rad_s = -self.learnt_rad_s
        bridged_rad, bridged_s = self._integrator.bridged_rad, self._integrator.bridged_s
        alone_rad = self._integrator.integrate(stamp_ns, rate_rad_s)
        self._bridged_rad += self._integrator.bridged_rad - bridged_rad
        self._bridged_rad -= self.learnt_rad_s * (self._integrator.bridged_s - bridged_s)
        self._learn(corrected_rad_s, (stamp_ns - self._done_ns) * 1e-9, seen)
        self._done_ns = stamp_ns
        heading_rad = self.corrected.heading_rad + self._bridged_rad
        return math.remainder(heading_rad, math.tau), alone_rad

    def _learn(self, rate_rad_s: float, passed_s: float, seen: tuple[float, float] | None) -> None:
        """Learn the bias from how far the gyroscope has turned ahead of what is seen."""
        self._by_gyroscope_rad += rate_rad_s * passed_s
        if seen is not None:
            ahead_rad = math.remainder(self._by_gyroscope_rad - seen[0], math.tau)
            if not abs(ahead_rad) <= ASTRAY_RAD:  # the start, or it was carried off
                self._by_gyroscope_rad, ahead_rad = seen[0], 0.0
            weighed_s_rad = passed_s * seen[1] * ahead_rad
            self._by_gyroscope_rad -= FOLLOWS_PER_S * weighed_s_rad
            self.learnt_rad_s += self._learning_per_s2 * weighed_s_rad
