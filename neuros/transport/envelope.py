"""The envelope of serialised messages: their compression, and tags that say whose they are.

What is in an envelope is told by the option bytes of the encapsulation header, which are zero in
what ROS serialises.

``"transport": {"compression": "zstd"}`` has the sender compress the serialised message with
Zstandard (RFC 8878). That takes processor time, so it is done only where the packet leaves the
machine. A compressed packet is told from an ordinary one as a parcel is (``large_packets.py``): by
the option bytes of its encapsulation header. Other readers of the topic could not read it: while
there are any, packets go as they are.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from neuros.errors import EnvironmentFault, ProtocolError
from neuros.transport.codecs import COMPRESSED_MARK, PARCEL_MARK

_OPTIONS, _START = slice(2, 4), 4
_LEVEL = 1  # an image of 640 x 480 in 1.2 ms; level 3 takes up to 7 ms and gains 3 %
_LARGEST = 1 << 30  # bytes; what claims to be larger when decompressed is refused


@dataclass
class Traffic:
    """Bytes that a sender has published on one connection: as messages, and as they were sent."""

    bytes: int = 0
    compressed_bytes: int = 0


class Compressor:
    """Compresses the packets of one output, each once for all its connections.

    Raises:
        EnvironmentFault: if the library is missing.
    """

    def __init__(self) -> None:
        self._zstd = _library()
        self._data = self._compressed = b""

    def compress(self, data: bytes) -> bytes:
        """A serialised message as it is sent; as it is where compression does not make it less."""
        if data is not self._data:
            body = self._zstd.compress(memoryview(data)[_START:], _LEVEL)
            compressed = b"".join((data[:2], COMPRESSED_MARK, body))
            self._data = data
            self._compressed = compressed if len(compressed) < len(data) else data
        return self._compressed


def compressing(
    compressor: Compressor,
    traffic: Traffic,
    count_readers: Callable[[], int],
    publish: Callable[[bytes], None],
) -> Callable[[bytes], None]:
    """``publish`` for what is compressed before, unless others read the topic, too."""

    def publish_compressed(data: bytes) -> None:
        sent = compressor.compress(data) if count_readers() == 1 else data
        traffic.bytes += len(data)
        traffic.compressed_bytes += len(sent)
        publish(sent)

    return publish_compressed


def decompressing(receive: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """``receive`` for packets that may be compressed.

    Raises:
        EnvironmentFault: if the library is missing.
    """
    zstd = _library()
    return lambda data: receive(
        _decompressed(data, zstd) if data[_OPTIONS] == COMPRESSED_MARK else data
    )


def _decompressed(data: bytes, zstd: Any) -> bytes:
    body = memoryview(data)[_START:]
    try:
        size = zstd.get_frame_info(body).decompressed_size
        if size is None or size > _LARGEST:
            raise ProtocolError(f"a compressed packet cannot be read: it claims {size} bytes")
        decompressor = zstd.ZstdDecompressor()  # DDS may have put padding behind the frame
        message: bytes = decompressor.decompress(body, size)
    except zstd.ZstdError as error:
        raise ProtocolError(f"a compressed packet cannot be read: {error}") from error
    if len(message) != size:
        raise ProtocolError("a compressed packet cannot be read: a part of it is missing")
    return data[:2] + b"\0\0" + message


@cache
def _library() -> Any:
    """The module of Zstandard: part of Python from 3.14, imported where it is used."""
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
    except ImportError as error:
        raise EnvironmentFault(
            f'"compression": "zstd" needs a package that is missing here ({error}):'
            " pip install backports.zstd"
        ) from None
    return zstd


# ---------------------------------------------------------------------- tags of messages
#
# Authentication of messages: a connection takes those of its registered nodes alone.
#
# Anybody in the ROS domain can publish on the topics of a connection, and rclpy does not tell a
# subscription who has published (the gid of the publisher stays in its C++ part). So each message
# carries a tag, which follows from a key and from the number of the message. The launcher makes a
# key for each connection between two nodes that it starts, and only they are told (``node.json``).
#
# - On ``/data`` the tag is 14 bits in the option bytes of the encapsulation header, which ROS and
#   its tools do not read (their last two bits count padding, DDSI-RTPS 2.5, 10.5). The number is
#   the one that DDS gives each message of a writer, from 1; one that has been there is not taken
#   again.
# - On ``/ack`` it stands beside the position, 64 bits, on ``/reg`` it is the last word of the text.
#
# A tag that is read off the topic is of no use: its number has passed. That keeps out whoever uses
# ROS. It does not keep out who writes a program that guesses tags, or packets of DDS itself: that
# takes a network of the run's own (``--isolate``).


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
