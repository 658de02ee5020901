"""Authentication of messages: a connection takes those of its registered nodes alone.

Anybody in the ROS domain can publish on the topics of a connection, and rclpy does not tell a
subscription who has published (the gid of the publisher stays in its C++ part). So each message
carries a tag, which follows from a key and from the number of the message. The launcher makes a key
for each connection between two nodes that it starts, and only they are told (``node.json``).

- On ``/data`` the tag is 14 bits in the option bytes of the encapsulation header, which ROS and its
  tools do not read (their last two bits count padding, DDSI-RTPS 2.5, 10.5). The number is the one
  that DDS gives each message of a writer, from 1; one that has been there is not taken again.
- On ``/ack`` it stands beside the position, 64 bits, on ``/reg`` it is the last word of the text.

A tag that is read off the topic is of no use: its number has passed. That keeps out whoever uses
ROS. It does not keep out who writes a program that guesses tags, or packets of DDS itself: that
takes a network of the run's own (``--isolate``).
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from array import array

from neuros.transport.large_packets import PARCEL_MARK

_BLOCK = 512
_HEADER_BYTES = 4
_OPTIONS = 0xFFFC
_IS_FREE = (b"\0\0", PARCEL_MARK)
_LITTLE_ENDIAN = b"\0\1\0\0"
# The header; no dimensions, no offset, two items, and a gap before them; position and tag.
_POSITION = struct.Struct("<4s3I4x2Q")
_BIG_ENDIAN_POSITION = struct.Struct(">4s3I4x2Q")


class Tags:
    """The tags of the messages on one topic, by number.

    Args:
        key: of the connection, hexadecimal.
        topic: which of its topics.
        typecode: of the tags, as ``array`` calls it.
    """

    def __init__(self, key: str, topic: str, typecode: str) -> None:
        self._seed = bytes.fromhex(key) + topic.encode()
        self._typecode = typecode
        self._block = -1
        self._tags: array[int] = array(typecode)

    def __getitem__(self, number: int) -> int:
        block, place = divmod(number, _BLOCK)
        if block != self._block:
            seed = self._seed + block.to_bytes(8, "little")
            self._tags = array(self._typecode)
            self._tags.frombytes(hashlib.shake_128(seed).digest(_BLOCK * self._tags.itemsize))
            self._block = block
        return self._tags[place]


class DataTags:
    """Tags of the packets of one connection, put in by its sender, taken out by its receiver."""

    def __init__(self, key: str) -> None:
        self._tags = Tags(key, "data", "H")
        self._last = 0

    def add(self, data: bytes) -> bytes:
        """The next serialised packet with its tag."""
        self._last += 1
        return self._changed(data, self._last)

    def remove(self, data: bytes, number: int) -> bytes | None:
        """The serialised packet with this number without its tag; ``None``: it is foreign."""
        if number <= self._last:
            return None
        packet = self._changed(data, number)
        if packet[2:_HEADER_BYTES] not in _IS_FREE:
            return None
        self._last = number
        return packet

    def _changed(self, data: bytes, number: int) -> bytes:
        header = int.from_bytes(data[:_HEADER_BYTES], "big") ^ (self._tags[number] & _OPTIONS)
        return header.to_bytes(_HEADER_BYTES, "big") + data[_HEADER_BYTES:]


class Positions:
    """Acknowledgements of one connection: a position and its tag.

    They travel as a ``std_msgs/msg/UInt64MultiArray``, made without a message object in between.

    Args:
        key: of the connection; ``None``: the other end has none, and any tag will do.
    """

    def __init__(self, key: str | None) -> None:
        self._tags = None if key is None else Tags(key, "ack", "Q")

    def encode(self, position: int) -> bytes:
        """A position as ``/ack`` carries it."""
        tag = 0 if self._tags is None else self._tags[position]
        return _POSITION.pack(_LITTLE_ENDIAN, 0, 0, 2, position, tag)

    def decode(self, data: bytes) -> int | None:
        """The position, from a sender of either byte order; ``None``: it is foreign."""
        if len(data) != _POSITION.size:
            return None
        position: int
        *_, position, tag = (_POSITION if data[1] else _BIG_ENDIAN_POSITION).unpack(data)
        return position if self._tags is None or tag == self._tags[position] else None


def signed(text: str, key: str) -> str:
    """A text of ``/reg`` with its tag."""
    tag = hashlib.blake2b(_encoded(text), key=bytes.fromhex(key), digest_size=8)
    return f"{text} {tag.hexdigest()}"


def verified(text: str, key: str) -> str | None:
    """The text without its tag; ``None``: it is foreign."""
    found = text.rpartition(" ")[0]
    return found if hmac.compare_digest(_encoded(signed(found, key)), _encoded(text)) else None


def _encoded(text: str) -> bytes:
    return text.encode(errors="surrogatepass")
