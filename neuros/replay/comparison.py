"""What a node sends in its replay, against what it sent in the run."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from neuros.observe.difference import differing_fields
from neuros.ports import Way

SIDES = ("the run", "the replay")

Topics: TypeAlias = "Mapping[tuple[Way, str], Sequence[tuple[str, str, Sequence[Any]]]]"
"""By way and port or connection: the name, type and packets of each topic."""


@dataclass
class _Stream:
    """What passes in one way: ``topics`` all carry the same packets."""

    topics: Sequence[tuple[str, str, Sequence[Any]]]
    sent: int = 0


class Comparison:
    """Compares packet by packet (:class:`neuros.ports.PacketRecorder`).

    Args:
        message: makes a message from bytes and the name of its type.
        lacking: topics of which not all packets were recorded.

    Attributes:
        difference: the first one, in a sentence; ``None`` so far.
    """

    def __init__(
        self,
        topics: Topics,
        message: Callable[[bytes, str], Any],
        lacking: Collection[str] = (),
    ) -> None:
        self._streams = [_Stream(each) for each in topics.values()]
        self._numbers = {key: number for number, key in enumerate(topics)}
        self._message = message
        self._lacking = lacking
        self.difference: str | None = None

    @property
    def packets(self) -> int:
        """Packets that were compared, once for each connection."""
        return sum(
            min(stream.sent, len(packets))
            for stream in self._streams
            for _, _, packets in stream.topics
        )

    @property
    def connections(self) -> int:
        """Connections, and external topics, that there are."""
        return sum(len(stream.topics) for stream in self._streams)

    def stream(self, way: Way, name: str) -> int | None:
        """The number of such packets; ``None`` if the run has not recorded them."""
        return self._numbers.get((way, name))

    def keep(self, stream: int, data: bytes, sim_time_s: float | None) -> None:
        """A packet was sent."""
        if self.difference is not None:
            return
        passed = self._streams[stream]
        passed.sent += 1
        for topic, type_name, packets in passed.topics:
            if passed.sent > len(packets) and topic in self._lacking:
                continue
            if passed.sent > len(packets):
                self.difference = (
                    f"{topic}: packet {passed.sent} is sent in the replay, and was not in the run"
                )
            elif packets[passed.sent - 1].data != data:
                self._compare(topic, type_name, passed.sent, packets[passed.sent - 1].data, data)
            if self.difference is not None:
                passed.sent -= 1
                return

    def find_missing(self) -> None:
        """The node will send nothing more."""
        for stream in self._streams:
            for topic, _, packets in stream.topics:
                if self.difference is None and stream.sent < len(packets):
                    self.difference = (
                        f"{topic}: the replay ends after packet {stream.sent}, the run has"
                        f" {len(packets)}"
                    )

    def close(self) -> None:
        """Nothing to close."""

    def _compare(
        self, topic: str, type_name: str, number: int, recorded: bytes, data: bytes
    ) -> None:
        """Bytes may differ where nothing but padding does."""
        pair = self._message(recorded, type_name), self._message(data, type_name)
        field = next(differing_fields(*pair, sides=SIDES), None)
        if field is not None:
            self.difference = f"{topic}: packet {number} differs in {field}"
