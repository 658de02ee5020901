"""Population codes: which rate each neuron of a population has for a value, and the value again.

A stimulus ``x`` (an angle, a position, a speed) becomes rates by a tuning curve per neuron; rates
or spikes become a direction by the population vector, or a position by the centre of mass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neuros.snn.spikes import Floats, Spikes, checked_indices, checked_positive, checked_rates


def evenly_spaced_angles(neurons: int) -> Floats:
    """Preferred directions all around the circle, ``2 pi i / n`` radians, ``(n,)``."""
    return 2.0 * np.pi * np.arange(int(checked_positive(neurons, "neurons"))) / neurons


@dataclass(frozen=True)
class GaussianTuning:
    """``rate = base + (peak - base) * exp(-(x - preferred)**2 / (2 width**2))``.

    Args:
        preferred: value of the stimulus at each neuron's peak, ``(n,)``.
        width: standard deviation of the curve, in units of the stimulus.
        peak_hz, base_hz: the highest and the lowest rate.
        period: the stimulus repeats itself after this much (``2 * math.pi`` for an angle in
            radians): differences are taken the short way round. ``None``: it does not.

    Raises:
        ValueError: ``width`` or ``period`` is not above 0, or not ``0 <= base_hz <= peak_hz``.

    Source: Dayan & Abbott (2001), equation 1.14.
    """

    preferred: Floats
    width: float
    peak_hz: float
    base_hz: float = 0.0
    period: float | None = None

    def __post_init__(self) -> None:
        checked_positive(self.width, "width")
        _check_range(self.base_hz, self.peak_hz)
        if self.period is not None:
            checked_positive(self.period, "period")

    def rates_hz(self, x: float) -> Floats:
        """Rate of every neuron for a stimulus, ``(n,)``."""
        away = x - np.asarray(self.preferred, dtype=np.float64)
        if self.period is not None:
            away = away - self.period * np.round(away / self.period)
        span_hz = self.peak_hz - self.base_hz
        return self.base_hz + span_hz * np.exp(-0.5 * (away / self.width) ** 2)


@dataclass(frozen=True)
class CosineTuning:
    """``rate = max(0, mean + depth * cos(x - preferred))``, with ``x`` in radians.

    Args:
        preferred_rad: direction of each neuron's highest rate, ``(n,)``.
        mean_hz: rate averaged over all directions, as long as nothing is cut off at 0.
        depth_hz: by how much it goes up and down. Where it is above ``mean_hz`` rates are cut off
            at 0, and the population vector of evenly spaced directions stays right.

    Source: Georgopoulos, Schwartz & Kettner, "Neuronal population coding of movement direction",
    *Science* 233, 1416 (1986).
    """

    preferred_rad: Floats
    mean_hz: float
    depth_hz: float

    def __post_init__(self) -> None:
        _check_range(0.0, self.mean_hz)
        _check_range(0.0, self.depth_hz)

    def rates_hz(self, x_rad: float) -> Floats:
        """Rate of every neuron for a direction in radians, ``(n,)``."""
        away = x_rad - np.asarray(self.preferred_rad, dtype=np.float64)
        return np.maximum(0.0, self.mean_hz + self.depth_hz * np.cos(away))


@dataclass(frozen=True)
class Direction:
    """A population vector.

    Attributes:
        angle_rad: where it points, in ``(-pi, pi]``; ``nan`` where nothing fired or all cancels.
        length: between 0 (activity all around) and 1 (all of it at one preferred direction).
    """

    angle_rad: float
    length: float


class PopulationVector:
    """Decodes a direction: unit vectors along the preferred directions, weighted by activity.

    ``sum(a_i * exp(1j * preferred_i)) / sum(a_i)``. Without bias if the preferred directions are
    evenly spaced and all tuning curves alike and symmetric; otherwise directions with many neurons
    attract it.

    Args:
        preferred_rad: ``(n,)``.

    Source: Georgopoulos, Schwartz & Kettner, *Science* 233, 1416 (1986); Dayan & Abbott (2001),
    section 3.3.
    """

    def __init__(self, preferred_rad: object) -> None:
        self._phasors = np.exp(1j * np.asarray(preferred_rad, dtype=np.float64))

    def of_rates(self, rates_hz: object) -> Direction:
        """From the rate (or the number of spikes, or any activity from 0 up) of each, ``(n,)``."""
        rates = checked_rates(rates_hz, self._phasors.size)
        # Not with @: the last digit of a BLAS product depends on the kind of processor.
        return self._direction(complex((rates * self._phasors).sum()), float(rates.sum()))

    def of_spikes(self, spikes: Spikes) -> Direction:
        """From spikes, each of which counts one."""
        index = checked_indices(spikes, self._phasors.size)
        return self._direction(complex(self._phasors[index].sum()), float(index.size))

    @staticmethod
    def _direction(vector: complex, activity: float) -> Direction:
        # What is left of vectors that cancel is rounding: it points nowhere.
        if abs(vector) <= 1e-12 * activity:
            return Direction(float("nan"), 0.0)
        return Direction(float(np.angle(vector)), abs(vector) / activity)


def centre_of_mass(rates_hz: object, preferred: Floats) -> float:
    """``sum(rate_i * preferred_i) / sum(rate_i)``, in units of the stimulus; ``nan`` without rates.

    For a stimulus on a line. At the ends of the line it is pulled inwards, since the curves there
    have neurons on one side only: let the preferred values go beyond by two widths.

    Source: Dayan & Abbott (2001), section 3.3: the maximum-likelihood estimate for Gaussian tuning
    curves that cover the line evenly and fire Poisson spikes.
    """
    values = np.asarray(preferred, dtype=np.float64)
    rates = checked_rates(rates_hz, values.size)
    total = float(rates.sum())
    return float((rates * values).sum()) / total if total > 0.0 else float("nan")


def _check_range(low_hz: float, high_hz: float) -> None:
    if not 0.0 <= low_hz <= high_hz < float("inf"):
        raise ValueError(f"rates must go up from 0 Hz or more: got {low_hz!r} to {high_hz!r}")
