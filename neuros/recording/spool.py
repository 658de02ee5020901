"""Spool: the packets that one node keeps, on their way into the bag.

A spool is a folder of files. A node appends to the newest one until it has some size; the recorder
reads behind the node, and removes a file once all of it is safe in the bag. A packet is one
``write`` to the page cache: it costs 2 us, or 0.2 ms for a megabyte, and survives its process.

A record is a header and the packet. The header has the length of the packet, the number of its
stream, its wall time and its simulated time, both in nanoseconds (-1: none).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from neuros.ports import Way
from neuros.recording.recording_plan import RecordedStream, RecordingPlan

FILE_BYTES = 8 << 20
MOST_BYTES = 1 << 27
"""The largest packet."""
NO_TIME = -1

_FOLDER = "spool"
_NAME = re.compile("[0-9]{8}")
_HEADER = struct.Struct("<IIqq")
_SMALL_BYTES = 4096  # up to here a copy costs less than a write in two parts


class SpoolRecord(NamedTuple):
    """A packet in a spool; times in nanoseconds.

    Attributes:
        wall_ns: when it was sent, in virtual time for a run in virtual time.
    """

    wall_ns: int
    sim_ns: int
    stream: int
    data: bytes


class ForwardClock:
    """Wall time in nanoseconds that goes on evenly when the clock is set back."""

    def __init__(self) -> None:
        self._ahead_ns = time.time_ns() - time.monotonic_ns()

    def __call__(self) -> int:
        # In this order, a pause between the two can only make the difference smaller.
        wall_ns, monotonic_ns = time.time_ns(), time.monotonic_ns()
        self._ahead_ns = max(self._ahead_ns, wall_ns - monotonic_ns)
        return monotonic_ns + self._ahead_ns


class SpoolWriter:
    """Keeps the packets of one node (:class:`neuros.ports.PacketRecorder`).

    Args:
        folder: of the node, in the run folder.
        streams: packets to keep; a record names its stream by the place in this list.
    """

    def __init__(
        self,
        folder: Path,
        streams: Sequence[RecordedStream],
        *,
        file_bytes: int = FILE_BYTES,
        clock: Callable[[], int] | None = None,
    ) -> None:
        self._folder = folder
        self._numbers: Mapping[tuple[Way, str], int] = {
            (Way(stream.way), stream.name): number for number, stream in enumerate(streams)
        }
        self._file_bytes = file_bytes
        self._clock = clock or ForwardClock()
        self._descriptor = -1
        self._files = 0
        self._size = 0
        self._last_ns = 0
        self._last_of_stream_ns: dict[int, int] = {}

    def stream(self, way: Way, name: str) -> int | None:
        return self._numbers.get((way, name))

    def keep(
        self, stream: int, data: bytes, sim_time_s: float | None, virtual_ns: int | None
    ) -> None:
        """Keep a packet. Raises ``OSError``; then it must not be called again."""
        now_ns = self._clock() if virtual_ns is None else virtual_ns
        # The time identifies a packet of the stream: no two have the same.
        last_ns = self._last_of_stream_ns.get(stream, -1)
        now_ns = max(now_ns, self._last_ns, last_ns + 1)
        self._last_ns = self._last_of_stream_ns[stream] = now_ns
        sim_ns = NO_TIME if sim_time_s is None else max(0, round(sim_time_s * 1e9))
        self.append(now_ns, sim_ns, stream, data)

    def append(self, wall_ns: int, sim_ns: int, stream: int, data: bytes) -> None:
        """Write a :class:`SpoolRecord`. Raises ``OSError``."""
        if len(data) > MOST_BYTES:
            why = f"a packet of {len(data)} bytes; {MOST_BYTES} are the most that can be recorded"
            raise OSError(errno.EFBIG, why)
        if self._descriptor < 0 or self._size >= self._file_bytes:
            self.close()
            flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_APPEND
            folder = self._folder / _FOLDER
            folder.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(_path(folder, self._files), flags, 0o644)
            fcntl.flock(self._descriptor, fcntl.LOCK_SH)  # until it is closed
            self._files += 1
            self._size = 0
        header = _HEADER.pack(len(data), stream, wall_ns, sim_ns)
        if len(data) <= _SMALL_BYTES:
            written = os.write(self._descriptor, header + data)
        else:
            written = os.writev(self._descriptor, (header, data))
        if written < _HEADER.size + len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._size += written

    def close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def open_recorder(plan: RecordingPlan, run: Path, node: str) -> SpoolWriter:
    return SpoolWriter(run / node, plan.streams.get(node, ()))


class SpoolReader:
    """Reads a spool behind its writer, or after its end."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file: int | None = None
        self._descriptor = -1
        self._rest = b""
        self._missing = 0  # bytes that complete the rest
        self._last_ns = 0
        self._done: list[tuple[int, int]] = []

    def read(self, most_bytes: int) -> tuple[list[SpoolRecord], bool]:
        """The next complete records, and whether there is more now."""
        records: list[SpoolRecord] = []
        left = most_bytes
        while left > 0 and not self.is_damaged:
            if self._descriptor < 0:
                numbers = [n for n in self._numbers() if self._file is None or n > self._file]
                if not numbers:
                    return records, False
                self._descriptor = self._open(numbers[0])
                self._file = numbers[0]
                self._rest, self._missing = b"", 0
            if self._has_more:  # a record that is larger than ``most_bytes`` comes whole
                data = os.read(self._descriptor, max(left, self._missing))
                left -= len(data)
                self._rest = _split(self._rest + data if self._rest else data, records)
                self._missing = _missing(self._rest)
                self._last_ns = records[-1].wall_ns if records else self._last_ns
            elif not _path(self._folder / _FOLDER, (self._file or 0) + 1).exists():
                return records, False
            elif not self._has_more:  # the file may have grown just before the next one was begun
                self._close_file()
        return records, not self.is_damaged

    @property
    def is_damaged(self) -> bool:
        """Whether a record claims to be larger than any packet; the reader stops there."""
        return self._missing > MOST_BYTES

    def __str__(self) -> str:
        return str(self._folder / _FOLDER)

    @property
    def has_files(self) -> bool:
        return bool(self._numbers())

    @property
    def is_fed(self) -> bool:
        """Whether a writer has the newest file open."""
        try:
            numbers = self._numbers()
            if not numbers:
                return False
            descriptor = self._open(numbers[-1])
        except OSError:
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return True
        finally:
            os.close(descriptor)
        return False

    def remove_up_to(self, wall_ns: int) -> None:
        """Remove the files that were read to their end, if all packets are up to ``wall_ns``."""
        while self._done and self._done[0][1] <= wall_ns:
            with contextlib.suppress(OSError):
                _path(self._folder / _FOLDER, self._done[0][0]).unlink()
            del self._done[0]

    def close(self, *, remove: bool) -> None:
        """Stop reading; ``remove``: also remove the files."""
        if self._descriptor >= 0:
            self._close_file()
        if remove:
            self.remove_up_to(self._last_ns)
            with contextlib.suppress(OSError):
                (self._folder / _FOLDER).rmdir()

    def _open(self, number: int) -> int:
        return os.open(_path(self._folder / _FOLDER, number), os.O_RDONLY)

    def _numbers(self) -> list[int]:
        try:
            names = os.listdir(self._folder / _FOLDER)
        except FileNotFoundError:
            return []
        return sorted(int(name) for name in names if _NAME.fullmatch(name))

    @property
    def _has_more(self) -> bool:
        """Whether the file has the rest of the record that has begun, or else any more bytes."""
        position = os.lseek(self._descriptor, 0, os.SEEK_CUR)
        return os.fstat(self._descriptor).st_size - position >= max(1, self._missing)

    def _close_file(self) -> None:
        os.close(self._descriptor)
        self._descriptor = -1
        self._done.append((self._file or 0, self._last_ns))


def _path(spool: Path, number: int) -> Path:
    return spool / f"{number:08d}"


def _split(data: bytes, records: list[SpoolRecord]) -> bytes:
    """Append the complete records in front to ``records``; returns the rest of the data."""
    at, end, head = 0, len(data), _HEADER.size
    unpack = _HEADER.unpack_from
    while at + head <= end:
        length, stream, wall_ns, sim_ns = unpack(data, at)
        after = at + head + length
        if after > end:
            break
        records.append(SpoolRecord(wall_ns, sim_ns, stream, data[at + head : after]))
        at = after
    return data[at:]


def _missing(rest: bytes) -> int:
    """How many bytes complete the record, or the header, that has begun."""
    if not rest:
        return 0
    whole = _HEADER.size
    if len(rest) >= whole:
        whole += _HEADER.unpack_from(rest)[0]
    return whole - len(rest)
