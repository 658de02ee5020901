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

from neuros.transport.codecs import COMPRESSED_MARK, PARCEL_MARK

_BLOCK = 512
_LITTLE_ENDIAN = b"\0\1"
_PLAIN = b"\0\1\0\0"
_IS_FREE = (b"\0\0", PARCEL_MARK, COMPRESSED_MARK)
# The header; no dimensions, no offset, two items, and a gap before them; position and tag.
_POSITION = struct.Struct("<4s3I4xQ8s")
_BIG_ENDIAN_POSITION = struct.Struct(">4s3I4xQ8s")


class Tags:
    """The tags of the messages on one topic, by number.

    Args:
        key: of the connection, hexadecimal.
        topic: which of its topics.
        mask: the bits of a tag that are used; it is as long as this.
    """

    def __init__(self, key: str, topic: str, mask: bytes) -> None:
        self._seed = bytes.fromhex(key) + topic.encode()
        self._size = len(mask)
        self._mask = int.from_bytes(mask * _BLOCK, "big")
        self._block = -1
        self._tags = b""

    def __getitem__(self, number: int) -> bytes:
        block, place = divmod(number, _BLOCK)
        if block != self._block:
            seed, size = self._seed + block.to_bytes(8, "little"), _BLOCK * self._size
            stream = int.from_bytes(hashlib.shake_128(seed).digest(size), "big")
            self._tags = (stream & self._mask).to_bytes(size, "big")
            self._block = block
        at = place * self._size
        return self._tags[at : at + self._size]


class DataTags:
    """Tags of the packets of one connection, put in by its sender, taken out by its receiver."""

    def __init__(self, key: str) -> None:
        self._tags = Tags(key, "data", b"\xff\xfc")
        self._last = 0

    def add(self, data: bytes) -> bytes:
        """The next serialised packet with its tag."""
        self._last += 1
        tag = self._tags[self._last]
        if data[:4] == _PLAIN:
            return _LITTLE_ENDIAN + tag + data[4:]
        return data[:2] + _exclusive_or(data[2:4], tag) + data[4:]

    def remove(self, data: bytes, number: int) -> bytes | None:
        """The serialised packet with this number without its tag; ``None``: it is foreign."""
        if number <= self._last:
            return None
        tag = self._tags[number]
        if data[:4] == _LITTLE_ENDIAN + tag:
            self._last = number
            return _PLAIN + data[4:]
        options = _exclusive_or(data[2:4], tag)
        if options not in _IS_FREE:
            return None
        self._last = number
        return data[:2] + options + data[4:]


def _exclusive_or(one: bytes, other: bytes) -> bytes:
    return bytes(a ^ b for a, b in zip(one, other, strict=False))


class Positions:
    """Acknowledgements of one connection: a position and its tag.

    They travel as a ``std_msgs/msg/UInt64MultiArray``, made without a message object in between.

    Args:
        key: of the connection; ``None``: the other end has none, and any tag will do.
    """

    def __init__(self, key: str | None) -> None:
        self._tags = None if key is None else Tags(key, "ack", b"\xff" * 8)

    def encode(self, position: int) -> bytes:
        """A position as ``/ack`` carries it."""
        tag = b"" if self._tags is None else self._tags[position]
        return _POSITION.pack(_PLAIN, 0, 0, 2, position, tag)

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
