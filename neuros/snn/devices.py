"""Into a NEST network and out of it, step by step: the coders' counterparts inside NEST.

Each takes the :class:`~neuros.snn.stepper.Stepper` of the network, to know the time and to be able
to clear a recorder. Neurons are counted from 0 in the order of the ``NodeCollection``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from neuros.snn.kernel import import_nest
from neuros.snn.spikes import Floats, Indices, Spikes, checked_indices, checked_rates
from neuros.snn.stepper import NS_PER_MS, NS_PER_S, Stepper


class RateInput:
    """Poisson spikes for every neuron, at rates that may change with every step.

    One ``poisson_generator`` per neuron: each keeps a rate of its own. (One generator for several
    neurons would give each of them other spikes of the same rate.) The generators draw from the
    kernel's random numbers: see :func:`~neuros.snn.kernel.reset_kernel`.

    Args:
        neurons: ``NodeCollection`` that receives.
        weight: of each synapse, in the unit of the neuron model (pA for current-based ones).
        delay_ms: from generator to neuron; a multiple of the resolution. It counts for the
            ``min_delay`` of the network.
    """

    def __init__(self, neurons: Any, weight: float, delay_ms: float = 1.0) -> None:
        nest = import_nest()
        self._generators = nest.Create("poisson_generator", len(neurons))
        nest.Connect(self._generators, neurons, "one_to_one", {"weight": weight, "delay": delay_ms})
        self._rates_hz = np.zeros(len(neurons))

    def set_rates(self, rates_hz: object) -> None:
        """From the next step on, in Hz, ``(n,)``. What has not changed costs nothing.

        Raises ``ValueError`` if the shape is wrong, or a rate is negative or not finite.
        """
        rates = checked_rates(rates_hz, self._rates_hz.size)
        changed = np.flatnonzero(rates != self._rates_hz)
        if changed.size:  # all at once: one by one takes ten times as long
            self._generators[changed].rate = rates[changed]
        self._rates_hz = rates.copy()


class SpikeInput:
    """Given spikes, such as those of a coder, for every neuron: a ``spike_generator`` each.

    Args:
        neurons: ``NodeCollection`` that receives.
        stepper: of the network.
        weight, delay_ms: as of :class:`RateInput`.
    """

    def __init__(
        self, neurons: Any, stepper: Stepper, weight: float, delay_ms: float = 1.0
    ) -> None:
        nest = import_nest()
        self._stepper = stepper
        stepper.release()
        self._generators = nest.Create("spike_generator", len(neurons))
        nest.Connect(self._generators, neurons, "one_to_one", {"weight": weight, "delay": delay_ms})
        self._loaded: Indices = np.zeros(0, dtype=np.int64)

    def play(self, spikes: Spikes) -> None:
        """Fire these in the steps to come, in place of what was to be played before.

        Times are simulated seconds; each is moved to the end of the resolution step that it lies
        in, at most one resolution later, and several of a neuron that fall on one step all count.

        Raises ``ValueError`` where a spike lies in the past, or the population has no such neuron.
        """
        index = checked_indices(spikes, len(self._generators))
        steps = self._steps_of(spikes.time_s)
        if steps.size and steps.min() <= self._stepper.steps:
            raise ValueError(
                f"a spike at {float(spikes.time_s.min())!r} s: the network is at "
                f"{self._stepper.time_s!r} s already"
            )
        firing = np.unique(index)
        changed = np.union1d(self._loaded, firing)
        if changed.size:
            trains = [self._train(steps[index == neuron]) for neuron in changed]
            self._generators[changed].set(trains)
        self._loaded = firing

    def _train(self, steps: Indices) -> dict[str, Any]:
        """The parameters of one generator."""
        own, multiplicities = np.unique(steps, return_counts=True)
        times_ms = own * self._stepper.resolution_ns / NS_PER_MS
        return {"spike_times": times_ms, "spike_multiplicities": multiplicities.astype(np.int64)}

    def _steps_of(self, time_s: Floats) -> Indices:
        """The step that each time lies in: (k - 1, k] is k, and the start of a step is in it."""
        time_ns = np.round(time_s * NS_PER_S).astype(np.int64)
        steps = -(-time_ns // self._stepper.resolution_ns)
        # A coder's window holds its first moment: that is the first step after it.
        return np.where(time_ns == self._stepper.time_ns, self._stepper.steps + 1, steps)


class SpikeReader:
    """The spikes of a population since the last look.

    A ``spike_recorder`` that is cleared by each :meth:`read`: a read costs as much as there are new
    spikes, and memory does not grow as long as one reads. (NEST itself gives all spikes since the
    recorder was made, every time.)

    Args:
        neurons: ``NodeCollection``.
        stepper: of the network.
        delay_ms: of the recorder's connections. They count for ``min_delay``: where all delays of
            the network are longer than 1 ms, say so here.
    """

    def __init__(self, neurons: Any, stepper: Stepper, delay_ms: float = 1.0) -> None:
        nest = import_nest()
        self._stepper = stepper
        stepper.release()
        self._recorder = nest.Create("spike_recorder")
        nest.Connect(neurons, self._recorder, syn_spec={"delay": delay_ms})
        ids = np.array(neurons.tolist())
        self._order = np.argsort(ids)
        self._ids = ids[self._order]

    def read(self) -> Spikes:
        """The spikes since the last read, in the order in which NEST has recorded them."""
        events = self._recorder.events
        senders = np.asarray(events["senders"], dtype=np.int64)
        # By whole nanoseconds: the times of NEST are milliseconds with rounding in the last digit.
        time_ns = np.round(np.asarray(events["times"], dtype=np.float64) * NS_PER_MS)
        if senders.size:
            self._stepper.clear(self._recorder)
        return Spikes(self._order[np.searchsorted(self._ids, senders)], time_ns / NS_PER_S)
