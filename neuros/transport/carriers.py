"""How a packet becomes bytes for the data topic of a connection, and a packet again.

The transport publishes and receives bytes only. So what is behind them can differ between two
connections of one output, and a packet is serialised once for all receivers with the same carrier.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Protocol

from rclpy.serialization import deserialize_message, serialize_message

from neuros.transport.cdr import Decode, Encode, cdr
from neuros.transport.cdr_parts import NOT_OURS


class Encoder(Protocol):
    """The sender's half of a carrier; connections of one output share it where they can."""

    def encode(self, packet: Any) -> bytes:
        """What is published for a packet, which may change as soon as this returns."""


class Decoder(Protocol):
    """The receiver's half of a carrier."""

    def decode(self, data: bytes) -> Any:
        """The packet that was published as ``data``; ``None`` if it was lost on its way."""


class Carrier(Encoder, Decoder, Protocol):
    """One way to carry packets."""


class MessageCarrier:
    """Messages as ROS serialises them: what every ROS node understands."""

    def __init__(self, kind: type) -> None:
        self._kind = kind

    def encode(self, packet: Any) -> bytes:
        """The serialised message."""
        data: bytes = serialize_message(packet)
        return data

    def decode(self, data: bytes) -> Any:
        """The message."""
        return deserialize_message(data, self._kind)


class QuickCarrier(MessageCarrier):
    """The same, in a fraction of the time where nothing is out of the ordinary."""

    def __init__(self, kind: type, encode: Encode, decode: Decode) -> None:
        super().__init__(kind)
        self._encode = encode
        self._decode = decode

    def encode(self, packet: Any) -> bytes:
        """The serialised message."""
        try:
            return self._encode(packet)
        except NOT_OURS:
            return super().encode(packet)

    def decode(self, data: bytes) -> Any:
        """The message."""
        try:
            return self._decode(data)
        except NOT_OURS:
            return super().decode(data)


@cache
def message_carrier(kind: type) -> Carrier:
    """The plain carrier for a message class."""
    quick = cdr(kind)
    return MessageCarrier(kind) if quick is None else QuickCarrier(kind, *quick)
