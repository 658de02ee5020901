"""Gives the packets of a node to the recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from neuros.ports import Logger, Tap, Way
from neuros.project.model import Connection
from neuros.runtime.simulated_time import SimulatedTime


class Keeper:
    """Serialises what is wanted for a tap, and goes on without it if the tap fails.

    Args:
        encode: serialises a packet.
        time: that of the node, if it has one.
    """

    def __init__(
        self,
        tap: Tap,
        encode: Callable[[Any], bytes],
        time: SimulatedTime,
        logger: Logger,
    ) -> None:
        self._tap: Tap | None = tap
        self._encode = encode
        self._time = time
        self._logger = logger

    def wanted_on_arrival(self, connections: Iterable[Connection]) -> frozenset[Connection]:
        """Connections whose packets are kept where they arrive: their senders are elsewhere."""
        tap = self._tap
        if tap is None:
            return frozenset()
        return frozenset(c for c in connections if tap.stream(Way.RECEIVED, str(c)) is not None)

    def keep(self, way: Way, name: str, packet: Any, data: bytes | None = None) -> None:
        """Record a packet, where that is wanted; ``data`` is the packet, if serialised already."""
        tap = self._tap
        if tap is None or (stream := tap.stream(way, name)) is None:
            return
        try:
            tap.keep(stream, data or self._encode(packet), self._time.now_s)
        except OSError as error:
            self.close()
            self._logger.error(
                f"its packets are not recorded from now on: {error.strerror}; the run goes on"
            )

    def close(self) -> None:
        """Record nothing any more."""
        if self._tap is not None:
            self._tap.close()
            self._tap = None
