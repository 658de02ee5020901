"""Compression of serialised messages.

``"transport": {"compression": "zstd"}`` has the sender compress the serialised message with
Zstandard (RFC 8878). That takes processor time, so it is done only where the packet leaves the
machine. A compressed packet is told from an ordinary one as a parcel is (``large_packets.py``): by
the option bytes of its encapsulation header. Other readers of the topic could not read it: while
there are any, packets go as they are.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from neuros.errors import EnvironmentFault, ProtocolError
from neuros.transport.codecs import COMPRESSED_MARK

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
