"""From rates to spikes, without a simulator.

Both coders give exact spike times, not bins: they lie in ``[start, start + duration)``, or, for
:class:`RegularEncoder`, in ``(start, start + duration]``, and for any cutting of time into windows
the train is that of one long window (for Poisson: in distribution).
"""

from __future__ import annotations

import numpy as np

from neuros.snn.spikes import Floats, Spikes, checked_positive, checked_rates


def poisson_spikes(
    rates_hz: object, duration_s: float, rng: np.random.Generator, start_s: float = 0.0
) -> Spikes:
    """Independent homogeneous Poisson processes, for a window in which their rates are constant.

    The number of spikes of a neuron is Poisson distributed with mean ``rate * duration``, and given
    the number, their times are independent and uniform over the window. No refractory time.

    Args:
        rates_hz: one per neuron, ``(n,)``, 0 or more.
        duration_s: of the window, above 0.
        rng: the source of randomness; ``numpy.random.default_rng(seed)`` makes one.
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

    ``d phase / dt = rate``; a spike when the phase reaches 1, which is then taken from it. What is
    left over from one window is kept for the next, so that after any time the number of spikes
    differs by less than one from the integral of the rate, and nothing is rounded to a time step.

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
        """The part of a spike that each neuron has integrated so far, in ``[0, 1)``, ``(n,)``."""
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
