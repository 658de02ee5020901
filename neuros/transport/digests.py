"""Digests of packets: 64 bits of XXH3 over the serialised message.

It does not depend on how the packet travelled. The published bytes of a large packet lack its
buffers, so the packet without them is digested, and then each buffer where it lies. XXH3 is no
cryptographic hash: it tells runs apart, not forgers from the honest. It was taken for its
speed (a camera's 921,600 bytes in 0.03 ms, where BLAKE2b takes 1.6 ms and CRC-32 0.4 ms).
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, TypeAlias

from xxhash import xxh3_64, xxh3_64_intdigest

from neuros.project.model import Connection
from neuros.transport.codecs import message_codec
from neuros.transport.large_packets import (
    LARGE_BYTES,
    Buffers,
    is_parcel,
    message_buffers,
    message_of,
)
from neuros.transport.messages import kind_of

Digest: TypeAlias = Callable[[bytes, Any], int]
"""From the bytes that a packet travels as, and the packet, to its digest."""

_WARMING_UP, _TRIED = 16, 48
_DEAR = 0.02
"""Share of a run that digests may cost unless the user has asked for them."""

Digests: TypeAlias = "dict[Connection, array[int]]"


def make_digests(connections: Sequence[Connection]) -> Digests:
    """An empty list of digests for each connection to or from another node."""
    return {c: array("Q") for c in connections if c.source_node != c.destination_node}


@cache
def digest_for(kind: Any) -> Digest:
    """The digest function of a message class, or of an array type."""
    buffers = message_buffers(kind)
    if buffers is None:
        return digest_of_bytes
    return _LargeDigest(buffers)


def digest_of(packet: Any) -> int:
    """The digest of a packet that does not travel as bytes."""
    kind = kind_of(packet)
    buffers = message_buffers(kind)
    if buffers is not None and _size(buffers.views(packet)) >= LARGE_BYTES:
        return _digest(buffers.encode_rest(packet), buffers, packet)
    return digest_of_bytes(message_codec(kind).encode(packet))


class TriedDigest:
    """Digests of packets in memory, for as long as they are cheap, which is measured once.

    A packet in memory is serialised for its digest alone. Of the first packets it is measured how
    long that takes, the median, as a share of the processor time in which they are sent; if that is
    too much, no packet of the process is digested any more. (Neither figure is larger for it that
    the machine does something else meanwhile.)

    Args:
        clock: monotonic, nanoseconds.
        worked: processor time of the process, nanoseconds.
    """

    def __init__(
        self,
        digest: Callable[[Any], int] = digest_of,
        clock: Callable[[], int] = time.perf_counter_ns,
        worked: Callable[[], int] = time.process_time_ns,
    ) -> None:
        self._digest = digest
        self._clock = clock
        self._worked = worked
        self._worked_before_ns = 0
        self._seen = 0
        self._took_ns: list[int] | None = []
        self._is_dear = False

    def __call__(self, packet: Any) -> int | None:
        """The digest of a packet; ``None``: they are too dear, and none are kept."""
        if self._took_ns is None:
            return None if self._is_dear else self._digest(packet)
        begun_ns = self._clock()
        found = self._digest(packet)
        self._seen += 1
        if self._seen == _WARMING_UP:  # its class is known now, its code is in the caches
            self._worked_before_ns = self._worked()
        elif self._seen > _WARMING_UP:
            self._took_ns.append(self._clock() - begun_ns)
            if len(self._took_ns) == _TRIED:
                in_all_ns = sorted(self._took_ns)[_TRIED // 2] * _TRIED  # the median
                self._is_dear = in_all_ns > _DEAR * (self._worked() - self._worked_before_ns)
                self._took_ns = None
        return None if self._is_dear else found


class _LargeDigest:
    """Digests messages that can be large."""

    def __init__(self, buffers: Buffers) -> None:
        self._buffers = buffers

    def __call__(self, data: bytes, packet: Any) -> int:
        if is_parcel(data):
            return _digest(message_of(data), self._buffers, packet)
        if len(data) < LARGE_BYTES or _size(self._buffers.views(packet)) < LARGE_BYTES:
            return digest_of_bytes(data)
        return _digest(self._buffers.encode_rest(packet), self._buffers, packet)


def digest_of_bytes(data: bytes, packet: Any = None) -> int:
    """The digest of a whole message, padded to four bytes, as it arrives (RTPS, 9.4.1).

    Of a JPEG, both ends have only the bytes; ``packet`` does not count.
    """
    missing = -len(data) % 4
    return int(xxh3_64_intdigest(data + bytes(missing) if missing else data))


def _digest(rest: bytes, buffers: Buffers, packet: Any) -> int:
    state = xxh3_64(rest)
    for view in buffers.views(packet):
        state.update(len(view).to_bytes(8, "little"))
        state.update(view)
    return int(state.intdigest())


def _size(views: Sequence[memoryview]) -> int:
    return sum(map(len, views))
