"""From spikes to rates, without a simulator: filters that keep state from one step to the next.

All are exact in time: a filter decays by ``exp(-dt / tau)`` for any step, so the lengths of steps
change nothing but rounding. Times are absolute simulated seconds: errors of steps do not add up.
"""

from __future__ import annotations

import numpy as np

from neuros.snn.spikes import Floats, Spikes, checked_indices, checked_positive

ROUNDING_S = 1e-9
"""By so much may a spike lie outside of its step: sums of floats of seconds are not exact."""


class _Clock:
    """Simulated time up to which a filter has come."""

    def __init__(self, start_s: float) -> None:
        self.now_s = start_s

    def advance(self, until_s: float, spikes: Spikes | None = None) -> float:
        """Go on to ``until_s``; returns by how much. The spikes must lie in between, ends included.

        Recorders count the last time of a step in, coders the first one: both are right here.
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
        """Take the spikes since the last call; the rates at ``until_s`` in Hz, ``(n,)``.

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
        """Take the spikes since the last call; the rates at ``until_s`` in Hz, ``(n,)``.

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
        """The filtered value at ``until_s``, the input having been ``value`` since the last call.

        Raises ``ValueError`` if time goes back or the shape is wrong.
        """
        target = np.asarray(value, dtype=np.float64)
        if target.shape != self._value.shape:
            raise ValueError(f"a value of shape {target.shape}, not {self._value.shape}")
        decay = np.exp(-self._clock.advance(until_s) / self._tau_s)
        self._value = target + (self._value - target) * decay
        return np.array(self._value)
