"""Spikes and arrays of the packets that pass a node, gathered for observers between two questions.

What is copied while a packet passes is bounded; it is encoded by the thread that answers.
"""

from __future__ import annotations

import base64
import time
from array import array
from collections.abc import Sequence
from typing import Any

from neuros.time import to_seconds

MOST_SPIKES = 20_000
"""Spikes per question; further ones are counted only."""
MOST_PACKETS = 4000
"""Packets per question of which spikes are gathered."""
MOST_ARRAYS = 20
"""Packets per question of which an array is read."""
LONGEST_ARRAY = 4096


class SpikeBatch:
    """Spikes of packets of type ``neuros_msgs/msg/Spikes``."""

    def __init__(self) -> None:
        self._senders, self._times = array("I"), array("d")
        self._size = self._count = self._packets = 0
        self._stamp_s = 0.0

    @property
    def is_full(self) -> bool:
        """Whether no further packet is looked at, so that a page that was left costs nothing."""
        return self._packets >= MOST_PACKETS or self._count > 2 * MOST_SPIKES

    def add(self, packet: Any) -> None:
        """Take the spikes of a packet.

        Raises:
            ValueError: if senders and times are not of one length.
        """
        senders, times = packet.senders, packet.times
        self._packets += 1
        if len(senders) != len(times):
            raise ValueError(f"{len(senders)} senders do not fit {len(times)} times")
        self._count += len(senders)
        self._size = max(self._size, packet.size)
        self._stamp_s = to_seconds(packet)
        room = max(0, MOST_SPIKES - len(self._times))
        self._times.extend(array("d", times[:room]))
        self._senders.extend(array("I", senders[:room]))

    def encode(self) -> dict[str, Any] | None:
        """The spikes, ready for JSON; ``None`` if no packet has passed.

        ``senders`` (uint32) and ``times`` (float64, seconds) are base64 of little-endian numbers;
        ``count`` is that of all spikes that passed, ``size`` that of the neurons, ``stamp_s`` the
        stamp of the last packet, in seconds.
        """
        if not self._packets:
            return None
        known = min(len(self._times), len(self._senders))  # the other thread may be adding
        return {
            "size": self._size,
            "count": self._count,
            "stamp_s": self._stamp_s,
            "senders": _base64(self._senders[:known]),
            "times": _base64(self._times[:known]),
        }


class ArrayBatch:
    """An array of each of a few packets.

    Args:
        steps: the path of the array in the packet.
    """

    def __init__(self, steps: Sequence[str | int]) -> None:
        self._steps = steps
        self._packets = 0
        self._rows: list[tuple[float, array[float], int]] = []

    @property
    def is_full(self) -> bool:
        """Whether no further packet is looked at."""
        return self._packets >= MOST_ARRAYS

    def add(self, packet: Any) -> None:
        """Take the array of a packet.

        Raises:
            AttributeError, LookupError, TypeError, ValueError: if there is no array of numbers.
        """
        self._packets += 1
        for step in self._steps:
            packet = packet[step] if isinstance(step, int) else getattr(packet, step)
        row = array("f", packet[:LONGEST_ARRAY])
        self._rows.append((time.monotonic(), row, len(packet)))

    def encode(self) -> list[list[Any]]:
        """Of each packet: when it passed (monotonic, seconds), its numbers, and how many it has.

        The numbers are base64 of float32, at most :data:`LONGEST_ARRAY`.
        """
        return [[time_s, _base64(row), length] for time_s, row, length in self._rows]


def _base64(numbers: array[Any]) -> str:
    return base64.b64encode(numbers.tobytes()).decode()
