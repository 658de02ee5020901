"""Instruments of a node see its packets as they pass, and are bound only where they are used.

A :class:`Passage` is a place where packets pass: an output, an input or a connection. Each
instrument (the clock, the sampler, the packet recorder) gets each passage once, when that is made,
and adds an observer where it needs the packets.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol, TypeAlias

from neuros.ordinary_files import reason_of
from neuros.ports import Logger, PacketRecorder, Way
from neuros.project.model import Connection, Port

Observe: TypeAlias = Callable[[Any, "bytes | None"], object]
"""Observes a packet; gets its serialisation, too, where that exists anyway."""


class Passage:
    """A place where packets pass a node.

    Attributes:
        port: the output or input.
        name: as recordings name the place: the port, or the connection where ``way`` is of one.
        observers: they are called with each packet, in this order.
    """

    __slots__ = ("name", "observers", "port", "way")

    def __init__(self, way: Way, port: Port, connection: Connection | None = None) -> None:
        self.way = way
        self.port = port
        self.name = port.name if connection is None else str(connection)
        self.observers: tuple[Observe, ...] = ()

    def add(self, observe: Observe) -> None:
        self.observers = (*self.observers, observe)

    def remove(self, observe: Observe) -> None:
        self.observers = tuple(each for each in self.observers if each is not observe)


class Instrument(Protocol):
    """Watches packets of a node."""

    def attach(self, passage: Passage) -> None:
        """Add observers to a passage, at once or while they are asked for."""


_MOST_PACKETS = 1000
_MOST_BYTES = 64_000_000


def room_for(size: int) -> int:
    """How many packets of so many bytes each a session can read of an output."""
    return max(1, min(_MOST_PACKETS, _MOST_BYTES // max(1, size)))


class PacketHistory:
    """The packets of one output, for a session: the newest, as many as there is room for.

    The size of the first one tells how many.

    Attributes:
        count: how many packets the output has sent.
        packets: the newest of them.
    """

    def __init__(self, size: int) -> None:
        self.count = 0
        self.packets: deque[Any] = deque(maxlen=room_for(size))

    def newest(self, most_bytes: int) -> list[bytes]:
        """The newest packets that have so many bytes together; the last one in any case."""
        found: list[bytes] = []
        for content in reversed(self.packets):
            most_bytes -= len(content)
            if found and most_bytes < 0:
                break
            found.append(content)
        return found[::-1]

    def since(self, number: int) -> list[Any]:
        """The packets after the one of this number (from 1) that are still there."""
        missing = self.count - number
        if missing == 1:
            return [self.packets[-1]]
        return [*self.packets][-missing:] if missing > 0 else []


class PacketHistories:
    """What a session can read of a node.

    Args:
        encode: serialises a packet.
        copy_of: the function that copies packets of a port, where the session is in the same
            process; ``None``: packets are kept serialised.

    Attributes:
        by_output: the packets of each output that has sent one.
    """

    def __init__(
        self,
        encode: Callable[[Any], bytes],
        copy_of: Callable[[Port], Callable[[Any], Any]] | None = None,
    ) -> None:
        self._encode = encode
        self._copy_of = copy_of
        self.by_output: dict[str, PacketHistory] = {}

    def attach(self, passage: Passage) -> None:
        """Keep what passes there, if it is an output."""
        if passage.way is not Way.SENT:
            return
        encode, copy = self._encode, self._copy_of and self._copy_of(passage.port)
        by_output, name = self.by_output, passage.name

        def keep(packet: Any, data: bytes | None) -> None:
            content = copy(packet) if copy else data or encode(packet)
            history = by_output.get(name)
            if history is None:
                size = len(encode(packet) if copy else content)
                history = by_output[name] = PacketHistory(size)
            history.count += 1
            history.packets.append(content)

        passage.add(keep)


class NodeRecorder:
    """Gives packets of one node, serialised, to its packet recorder, until that fails.

    Args:
        encode: serialises a packet.
        sim_time_s: the simulated time of the node, ``None`` where it owns none.
        virtual_ns: nanoseconds of virtual time since time 0, ``None`` in real time.

    Attributes:
        failure: why nothing more is recorded, ``None`` while all is well.
    """

    def __init__(
        self,
        recorder: PacketRecorder,
        encode: Callable[[Any], bytes],
        sim_time_s: Callable[[], float | None],
        virtual_ns: Callable[[], int | None],
        logger: Logger,
    ) -> None:
        self._recorder: PacketRecorder | None = recorder
        self._encode = encode
        self._sim_time_s = sim_time_s
        self._virtual_ns = virtual_ns
        self._logger = logger
        self.failure: str | None = None

    def attach(self, passage: Passage) -> None:
        """Keep the packets there, if they are recorded."""
        if self._recorder is None:
            return
        stream = self._recorder.stream(passage.way, passage.name)
        if stream is not None:
            number = stream
            passage.add(lambda packet, data: self.keep(number, packet, data))

    def keep(self, stream: int, packet: Any, data: bytes | None) -> None:
        """Record a packet; ``data`` is the packet, if serialised already."""
        if self._recorder is None:
            return
        try:
            times = self._sim_time_s(), self._virtual_ns()
            self._recorder.keep(stream, data or self._encode(packet), *times)
        except OSError as error:
            self.close()
            self.failure = f"its packets are not recorded to the end: {reason_of(error)}"
            self._logger.error(
                f"its packets are not recorded from now on: {reason_of(error)}; the run goes on"
            )

    def close(self) -> None:
        """Record nothing any more."""
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None
