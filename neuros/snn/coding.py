"""Spikes of a population: from rates to spikes and back, and population codes.

It needs NumPy alone. Times are absolute simulated seconds, so errors of steps do not add up. Coders
give exact spike times: they lie in ``[start, start + duration)``, or for :class:`RegularEncoder` in
``(start, start + duration]``, and cutting a window into several does not change the train (for
Poisson: its distribution). Filters decay by ``exp(-dt / tau)``, exactly for any step.

A stimulus ``x`` (an angle, a position, a speed) becomes rates by a tuning curve per neuron; rates
or spikes become a direction by the population vector, or a position by the centre of mass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
ROUNDING_S = 1e-9
"""Tolerance for spikes outside of their step: sums of floats of seconds are not exact."""


@dataclass(frozen=True)
class Spikes:
    """Spikes of a population, one entry per spike.

    Attributes:
        neuron: index within the population, from 0, ``(k,)``.
        time_s: since simulated time zero, in seconds, ``(k,)``.

    Coders give spikes in the order of time, NEST's recorder by time slices.
    """

    neuron: Indices
    time_s: Floats

    def __post_init__(self) -> None:
        if self.neuron.ndim != 1 or self.neuron.shape != self.time_s.shape:
            raise ValueError(
                f"spikes need one time per neuron index: {self.neuron.shape} indices, "
                f"{self.time_s.shape} times"
            )

    def __len__(self) -> int:
        return int(self.neuron.size)

    def in_order(self) -> Spikes:
        """The same spikes, ordered by time, then by neuron."""
        order = np.lexsort((self.neuron, self.time_s))
        return Spikes(self.neuron[order], self.time_s[order])

    def into(self, packet: Any, neurons: int) -> Any:
        """Write the spikes, ordered by time, into a ``neuros_msgs/msg/Spikes`` and return it.

        The caller sets the header: its stamp is the end of the time that the spikes cover.
        Raises ``ValueError`` if a spike's neuron is not below ``neurons``, the population's size.
        """
        spikes = self.in_order()
        packet.size = neurons
        packet.senders = checked_indices(spikes, neurons).astype(np.uint32)
        packet.times = spikes.time_s
        return packet

    @classmethod
    def of(cls, packet: Any) -> Spikes:
        """The spikes in a ``neuros_msgs/msg/Spikes``."""
        return cls(np.array(packet.senders, np.int64), np.array(packet.times, np.float64))

    def counts(self, neurons: int) -> Indices:
        """The number of spikes of each neuron, ``(neurons,)``."""
        return np.bincount(checked_indices(self, neurons), minlength=neurons)


def checked_indices(spikes: Spikes, neurons: int) -> Indices:
    """The neuron indices. Raises ``ValueError`` for one that the population does not have."""
    index = spikes.neuron
    is_foreign = (index < 0) | (index >= neurons)
    if np.any(is_foreign):
        raise ValueError(
            f"a spike of neuron {index[is_foreign][0]} in a population of {neurons}: "
            "indices count from 0"
        )
    return index


def checked_rates(rates_hz: object, neurons: int | None = None) -> Floats:
    """Rates as an array ``(n,)`` of hertz. Raises ``ValueError`` unless finite and not negative."""
    rates = np.asarray(rates_hz, dtype=np.float64)
    if rates.ndim != 1 or neurons not in (None, rates.size):
        wanted = "(n,)" if neurons is None else f"({neurons},)"
        raise ValueError(f"rates must have the shape {wanted}, one per neuron: got {rates.shape}")
    if not np.all(np.isfinite(rates)) or np.any(rates < 0.0):
        worst = int(np.flatnonzero(~(np.isfinite(rates) & (rates >= 0.0)))[0])
        raise ValueError(f"rate of neuron {worst} is {rates[worst]} Hz: it must be 0 or more")
    return rates


def checked_positive(value: float, name: str) -> float:
    """The value. Raises ``ValueError`` unless it is finite and above zero."""
    if not (np.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} must be above 0: got {value!r}")
    return float(value)


def poisson_spikes(
    rates_hz: object, duration_s: float, rng: np.random.Generator, start_s: float = 0.0
) -> Spikes:
    """Independent homogeneous Poisson processes, for a window in which their rates are constant.

    The number of spikes of a neuron is Poisson distributed with mean ``rate * duration``, and given
    the number, their times are independent and uniform over the window. No refractory time.

    Args:
        rates_hz: one per neuron, ``(n,)``, 0 or more.
        duration_s: of the window, above 0.
        rng: the source of randomness.
        start_s: simulated time at which the window begins.

    Raises:
        ValueError: a rate is negative or not finite, or the duration is not above 0.

    Source: Dayan & Abbott, *Theoretical Neuroscience* (2001), section 1.4.
    """
    rates = checked_rates(rates_hz)
    duration_s = checked_positive(duration_s, "duration_s")
    counts = rng.poisson(rates * duration_s)
    neuron = np.repeat(np.arange(rates.size), counts)
    time_s = start_s + duration_s * rng.random(neuron.size)
    return Spikes(neuron, time_s).in_order()


class RegularEncoder:
    """Evenly spaced spikes: perfect (leakless) integrate-and-fire neurons driven by their rates.

    ``d phase / dt = rate``; at phase 1 the neuron fires and the phase falls by 1. The phase carries
    over to the next window, so that at any time the number of spikes differs by less than one from
    the integral of the rate, and nothing is rounded to a time step.

    Args:
        neurons: how many.
        rng: draws the phases to start from, uniformly, so that equal rates do not fire together.
            ``None``: all start at phase 0.

    Source: the perfect integrator, Dayan & Abbott (2001), section 5.4 without its leak;
    Lapicque (1907).
    """

    def __init__(self, neurons: int, rng: np.random.Generator | None = None) -> None:
        self._neurons = int(checked_positive(neurons, "neurons"))
        self._phase = np.zeros(self._neurons) if rng is None else rng.random(self._neurons)

    @property
    def phase(self) -> Floats:
        """The phase of each neuron, in ``[0, 1)``, ``(n,)``."""
        return np.array(self._phase)

    def encode(self, rates_hz: object, duration_s: float, start_s: float = 0.0) -> Spikes:
        """The spikes of the next window, in which the rates ``(n,)`` are constant.

        Raises ``ValueError`` as :func:`poisson_spikes` does.
        """
        rates = checked_rates(rates_hz, self._neurons)
        duration_s = checked_positive(duration_s, "duration_s")
        reached = self._phase + rates * duration_s
        counts = np.floor(reached).astype(np.int64)
        neuron = np.repeat(np.arange(self._neurons), counts)
        nth = np.arange(neuron.size) - np.repeat(np.cumsum(counts) - counts, counts) + 1
        after_s = (nth - self._phase[neuron]) / rates[neuron]
        self._phase = reached - counts
        return Spikes(neuron, start_s + np.minimum(after_s, duration_s)).in_order()


class _Clock:
    """The simulated time of a filter."""

    def __init__(self, start_s: float) -> None:
        self.now_s = start_s

    def advance(self, until_s: float, spikes: Spikes | None = None) -> float:
        """Set the time to ``until_s`` and return the elapsed seconds.

        Raises ``ValueError`` for spikes outside of that time. Both ends count as inside: recorders
        include the end of a step, coders its start.
        """
        elapsed_s = until_s - self.now_s
        if not elapsed_s >= 0.0:
            raise ValueError(f"time goes back, from {self.now_s!r} s to {until_s!r} s")
        if spikes is not None and len(spikes):
            first_s, last_s = float(spikes.time_s.min()), float(spikes.time_s.max())
            if first_s < self.now_s - ROUNDING_S or last_s > until_s + ROUNDING_S:
                raise ValueError(
                    f"spikes from {first_s!r} to {last_s!r} s do not belong to the step from "
                    f"{self.now_s!r} to {until_s!r} s"
                )
        self.now_s = until_s
        return elapsed_s


class WindowRate:
    """Spikes of the last ``window_s`` seconds, divided by that: ``count((t - T, t]) / T`` in Hz.

    Unbiased; a change of rate is seen in full after ``T``, half of it after ``T / 2``; its standard
    deviation for Poisson spikes is ``sqrt(rate / T)``.

    Args:
        neurons: how many.
        window_s: ``T``, above 0. Until so much time has gone by, all of the window counts.
        start_s: simulated time of the start.

    Source: Dayan & Abbott (2001), section 1.2 (sliding rectangular window, causal).
    """

    def __init__(self, neurons: int, window_s: float, start_s: float = 0.0) -> None:
        self._neurons = int(checked_positive(neurons, "neurons"))
        self._window_s = checked_positive(window_s, "window_s")
        self._clock = _Clock(start_s)
        self._kept = Spikes(np.zeros(0, dtype=np.int64), np.zeros(0))

    def update(self, spikes: Spikes, until_s: float) -> Floats:
        """The rates at ``until_s`` in Hz, ``(n,)``, given the spikes since the last call.

        Raises ``ValueError`` where time goes back or spikes lie outside of the step.
        """
        checked_indices(spikes, self._neurons)
        self._clock.advance(until_s, spikes)
        neuron = np.concatenate((self._kept.neuron, spikes.neuron))
        time_s = np.concatenate((self._kept.time_s, spikes.time_s))
        is_recent = time_s > until_s - self._window_s
        self._kept = Spikes(neuron[is_recent], time_s[is_recent])
        return self._kept.counts(self._neurons) / self._window_s


class ExponentialRate:
    """Spikes filtered with a causal exponential: ``sum(exp(-(t - t_i) / tau) / tau)`` in Hz.

    The kernel has the area 1: unbiased once several ``tau`` have gone by. A change of rate is seen
    to 63% after ``tau``; its standard deviation for Poisson spikes is ``sqrt(rate / (2 tau))``. It
    is as exact as the spike times, and keeps ``n`` numbers, where :class:`WindowRate` keeps spikes.

    Args:
        neurons: how many.
        tau_s: time constant, above 0.
        start_s: simulated time of the start.

    Source: Dayan & Abbott (2001), section 1.2 (causal kernels).
    """

    def __init__(self, neurons: int, tau_s: float, start_s: float = 0.0) -> None:
        self._rates_hz = np.zeros(int(checked_positive(neurons, "neurons")))
        self._tau_s = checked_positive(tau_s, "tau_s")
        self._clock = _Clock(start_s)

    def update(self, spikes: Spikes, until_s: float) -> Floats:
        """The rates at ``until_s`` in Hz, ``(n,)``, given the spikes since the last call.

        Raises ``ValueError`` where time goes back or spikes lie outside of the step.
        """
        neurons = self._rates_hz.size
        index = checked_indices(spikes, neurons)
        elapsed_s = self._clock.advance(until_s, spikes)
        fresh = np.exp((spikes.time_s - until_s) / self._tau_s) / self._tau_s
        self._rates_hz = self._rates_hz * np.exp(-elapsed_s / self._tau_s)
        self._rates_hz += np.bincount(index, weights=fresh, minlength=neurons)
        return np.array(self._rates_hz)


class LeakyIntegrator:
    """Low-pass of a value that is constant over each step: ``tau dy/dt = u - y``.

    Integrated exactly: ``y <- u + (y - u) * exp(-dt / tau)``. An Euler step, ``y + dt / tau *
    (u - y)``, gives other values for other steps, and becomes unstable beyond ``2 tau``.

    Args:
        initial: ``y`` at the start, any shape; the inputs must have the same.
        tau_s: time constant, above 0.
        start_s: simulated time of the start.

    Source: exact integration, Rotter & Diesmann, *Biol. Cybern.* 81, 381 (1999).
    """

    def __init__(self, initial: object, tau_s: float, start_s: float = 0.0) -> None:
        self._value = np.array(initial, dtype=np.float64)
        self._tau_s = checked_positive(tau_s, "tau_s")
        self._clock = _Clock(start_s)

    def update(self, value: object, until_s: float) -> Floats:
        """The filtered value at ``until_s``, for an input of ``value`` since the last call.
        Raises ``ValueError`` if time goes back or the shape is wrong.
        """
        target = np.asarray(value, dtype=np.float64)
        if target.shape != self._value.shape:
            raise ValueError(f"a value of shape {target.shape}, not {self._value.shape}")
        decay = np.exp(-self._clock.advance(until_s) / self._tau_s)
        self._value = target + (self._value - target) * decay
        return np.array(self._value)


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
        period: of a periodic stimulus (``2 * math.pi`` for an angle in radians); differences
            are the shorter way round. ``None``: not periodic.

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
        mean_hz: rate averaged over all directions, if no rate is cut off at 0.
        depth_hz: amplitude. Above ``mean_hz`` rates are cut off at 0; the population vector of
            evenly spaced directions stays right.

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
        angle_rad: its direction, in ``(-pi, pi]``; ``nan`` without activity, or if all cancels.
        length: between 0 (activity all around) and 1 (all activity at one preferred direction).
    """

    angle_rad: float
    length: float


class PopulationVector:
    """Decodes a direction: unit vectors along the preferred directions, weighted by activity.

    ``sum(a_i * exp(1j * preferred_i)) / sum(a_i)``. Without bias if the preferred directions are
    evenly spaced and all tuning curves alike and symmetric; otherwise directions with many neurons
    are preferred.

    Args:
        preferred_rad: ``(n,)``.

    Source: Georgopoulos, Schwartz & Kettner, *Science* 233, 1416 (1986); Dayan & Abbott (2001),
    section 3.3.
    """

    def __init__(self, preferred_rad: object) -> None:
        self._phasors = np.exp(1j * np.asarray(preferred_rad, dtype=np.float64))

    def of_rates(self, rates_hz: object) -> Direction:
        """From the rate, number of spikes, or other activity from 0 up of each neuron, ``(n,)``."""
        rates = checked_rates(rates_hz, self._phasors.size)
        # Not with @: the last digit of a BLAS product depends on the kind of processor.
        return self._direction(complex((rates * self._phasors).sum()), float(rates.sum()))

    def of_spikes(self, spikes: Spikes) -> Direction:
        """From spikes, each of which counts one."""
        index = checked_indices(spikes, self._phasors.size)
        return self._direction(complex(self._phasors[index].sum()), float(index.size))

    @staticmethod
    def _direction(vector: complex, activity: float) -> Direction:
        # Vectors that cancel leave a rounding error, which has no direction.
        if abs(vector) <= 1e-12 * activity:
            return Direction(float("nan"), 0.0)
        return Direction(float(np.angle(vector)), abs(vector) / activity)


def centre_of_mass(rates_hz: object, preferred: Floats) -> float:
    """``sum(rate_i * preferred_i) / sum(rate_i)``, in units of the stimulus; ``nan`` without rates.

    For a stimulus on a line. Near the ends of the line the result is pulled inwards, since only one
    side has neurons: let the preferred values go beyond by two widths.

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
