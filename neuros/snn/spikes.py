"""Spikes of a population, by neuron and time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Spikes:
    """Spikes of a population, one entry per spike.

    Attributes:
        neuron: index within the population, from 0, ``(k,)``.
        time_s: since simulated time zero, in seconds, ``(k,)``.

    Coders give spikes in the order of time. NEST's recorder gives them in its own, by time slices.
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
        """The same spikes, by time; of one time, by neuron."""
        order = np.lexsort((self.neuron, self.time_s))
        return Spikes(self.neuron[order], self.time_s[order])

    def into(self, packet: Any, neurons: int) -> Any:
        """Put the spikes into a ``neuros_msgs/msg/Spikes``, by time; returns that message.

        Its header is the caller's: the stamp says until when these are all spikes.

        Args:
            neurons: size of the population.

        Raises:
            ValueError: if a spike is of none of these neurons.
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
        """How many of them each of so many neurons fired, ``(neurons,)``."""
        return np.bincount(checked_indices(self, neurons), minlength=neurons)


def checked_indices(spikes: Spikes, neurons: int) -> Indices:
    """The indices of the neurons. Raises ``ValueError`` where the population has no such one."""
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
