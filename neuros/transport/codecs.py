"""Codecs: a packet to the bytes that its data topic carries, and back.

The transport publishes and receives bytes only. So what is behind them can differ between two
connections of one output, and a packet is serialised once for all receivers with one codec.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Protocol

from rclpy.serialization import deserialize_message, serialize_message

from neuros.transport.cdr import NOT_OURS, Decode, Encode, cdr


class Encoder(Protocol):
    """The sender's half of a codec; connections of one output share it where they can."""

    def encode(self, packet: Any) -> bytes:
        """Serialise a packet, which may change as soon as this returns."""


class Decoder(Protocol):
    """The receiver's half of a codec."""

    def decode(self, data: bytes) -> Any:
        """The packet that was published as ``data``; ``None`` if it was lost on its way."""


class Codec(Encoder, Decoder, Protocol):
    """One way to carry packets."""


class MessageCodec:
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


class CdrCodec(MessageCodec):
    """Messages in plain CDR by NeuROS itself, in a fraction of the time; the rest by rclpy."""

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
def message_codec(kind: type) -> Codec:
    """The plain codec for a message class."""
    quick = cdr(kind)
    return MessageCodec(kind) if quick is None else CdrCodec(kind, *quick)
