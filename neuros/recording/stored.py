"""Messages that are stored in the files of a bag, read as far as they go, and checked.

A file of a run that was killed, or that something has happened to since, is read from its
beginning. Checksums of chunks and of the summary tell what is not as it was written.
"""

from __future__ import annotations

import os
import sqlite3
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from struct import error as struct_error
from struct import unpack, unpack_from
from textwrap import shorten
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from neuros.errors import EnvironmentFault
from neuros.ordinary_files import open_ordinary
from neuros.recording.bag_files import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    CHUNK_INDEX,
    DATA_END,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD_HEAD,
    types_of_fields,
)


class Stored(NamedTuple):
    """A message of a bag; times in nanoseconds.

    ``may_have_changed``: the checksum of its part of the file is wrong.
    """

    topic: str
    log_ns: int
    publish_ns: int
    data: bytes
    may_have_changed: bool = False


def stored_messages(
    folder: Path, complain: Callable[[str], object] = lambda _: None
) -> Iterator[Stored]:
    """All messages in the files of a bag's folder, as far as they go.

    Args:
        complain: told in one sentence of each part of a file that is not as it was written.

    Raises:
        EnvironmentFault: if they are compressed, which is not how NeuROS records.
    """
    for path in sorted(folder.glob("*.mcap")):
        with open_ordinary(path) as file:
            for topic, log_ns, publish_ns, _, data, is_right in _of_mcap(file, complain):
                yield Stored(topic, log_ns, publish_ns, bytes(data), not is_right)
    for path in sorted(folder.glob("*.db3")):
        yield from _of_sqlite(path, complain)


class StoredTopics:
    """The messages of a bag's folder, topic by topic.

    With the first topic an MCAP file is gone through once, and it is noted where each message is:
    32 bytes for one.

    Args:
        complain: told in one sentence of each part of a file that is not as it was written.
    """

    def __init__(self, folder: Path, complain: Callable[[str], object]) -> None:
        self._folder = folder
        self._complain = complain
        self._places: dict[Path, Mapping[str, array[int]]] = {}

    def messages(self, topic: str) -> list[Stored]:
        """Messages of one topic, as far as they go. Raises ``EnvironmentFault`` as above."""
        found: list[Stored] = []
        for path in sorted(self._folder.glob("*.mcap")):
            with open_ordinary(path) as file:
                if path not in self._places:
                    self._places[path] = _places_in(file, self._complain)
                row = iter(self._places[path].get(topic, ()))
                for log_ns, publish_ns, start, size in zip(row, row, row, row, strict=True):
                    data = os.pread(file.fileno(), size, start)
                    found.append(Stored(topic, log_ns, publish_ns, data))
        for path in sorted(self._folder.glob("*.db3")):
            found += _of_sqlite(path, self._complain, topic)
        return found


def faults_of(folder: Path, counts: Mapping[str, int]) -> list[str]:
    """What is not as it was written, a sentence each; reads all of a bag.

    Args:
        counts: by topic, how many messages there should be.

    Raises:
        EnvironmentFault: as :func:`stored_messages`.
    """
    faults: list[str] = []
    found = Counter(message.topic for message in stored_messages(folder, faults.append))
    return faults or [
        are_left(folder, name, count, found[name])
        for name, count in counts.items()
        if found[name] < count
    ]


def are_left(folder: Path, topic: str, count: int, left: int) -> str:
    """A sentence on messages that are not there."""
    return f"{folder}: of {count} packets of {topic} {left} are left"


def is_whole(folder: Path) -> bool:
    """Whether readers will open a bag: metadata, beginning and end of its files, and types."""
    try:
        with opened(folder) as reader, damage_of(folder):
            store_of(reader.connections)
            return True
    except EnvironmentFault:
        return False


@contextmanager
def opened(folder: Path) -> Iterator[Reader]:
    """A bag as ``rosbags`` opens it.

    Raises:
        EnvironmentFault: if it cannot.
    """
    with ExitStack() as stack:
        with damage_of(folder):
            _check_summaries(folder)
            reader = Reader(folder)
            reader.open()
            stack.callback(reader.close)
            _check_definitions(reader)
        yield reader


def store_of(connections: Iterable[Connection]) -> Typestore:
    """The types as a bag defines them. Raises ``ReaderError``, and whatever the parser raises."""
    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    for connection in connections:
        types |= get_types_from_msg(connection.msgdef.data, connection.msgtype)
    store.register(types)
    for name, (_, fields) in types.items():
        if unknown := next((used for used in types_of_fields(fields) if used not in types), None):
            raise ReaderError(f"it does not define {unknown}, which {name} has")
    return store


@contextmanager
def damage_of(folder: Path, what: str = "") -> Iterator[None]:
    """Turn what ``rosbags`` raises for a bag into ``EnvironmentFault``; that may be anything.

    Args:
        what: the part of the bag that is read; all of it if empty.
    """
    try:
        yield
    except EnvironmentFault:
        raise
    except Exception as error:
        why = shorten(str(error), 200, placeholder=" ...") or type(error).__name__
        place = f"{folder}: {what}" if what else str(folder)
        raise EnvironmentFault(f"{place} cannot be read: it is damaged ({why})") from error


def _check_definitions(reader: Reader) -> None:
    """Raise ``ReaderError`` where metadata and files do not agree."""
    folder = reader.storage if isinstance(reader.storage, DirectoryReader) else None
    if folder and not isinstance(folder.files, list):
        folder.files = []  # else it could not be closed
        raise ReaderError("in metadata.yaml, files is no list")
    storages = folder.storages if folder else ()
    stored = [each for storage in storages for each in storage.connections]
    there = {each.topic for each in stored}
    named = {each.topic for each in reader.connections}
    if unnamed := next((e.topic for e in stored if e.msgcount and e.topic not in named), ""):
        raise ReaderError(f"metadata.yaml does not name the topic {unnamed}, which its files have")
    for connection in reader.connections:
        if type(connection.msgcount) is not int or connection.msgcount < 0:
            raise ReaderError(f"{connection.topic} has {connection.msgcount} packets")
        is_there = connection.topic in there or not connection.msgcount
        if connection.msgdef.format == MessageDefinitionFormat.NONE or not is_there:
            what = f"{connection.topic} of type {connection.msgtype}"
            raise ReaderError(f"its files do not have the topic {what}")


def _check_summaries(folder: Path) -> None:
    """Raise ``ReaderError`` where an MCAP file has not the checksum that its footer says.

    Raises ``OSError`` for what is no file, such as a pipe.
    """
    for path in folder.glob("*"):
        if path.suffix in (".mcap", ".db3", ".yaml"):
            with open_ordinary(path) as file:
                if path.suffix == ".mcap":
                    _summary_of(file)


def _summary_of(file: BinaryIO) -> bytes:
    """The records between the data of an MCAP file and its end, and the start of the last one.

    Raises:
        ReaderError: if their checksum is wrong.
    """
    name = Path(file.name).name
    end = file.seek(0, os.SEEK_END) - len(MAGIC) - 4
    if end < 16:
        raise ReaderError(f"{name} has no end")
    file.seek(end - 16)
    start, _, checksum = unpack("<QQI", file.read(20))
    file.seek(min(start, end))
    summary = file.read(end - min(start, end))
    if checksum and crc32(summary) != checksum:
        raise ReaderError(f"the summary of {name} is not what was written")
    return summary


def _places_in(file: BinaryIO, complain: Callable[[str], object]) -> Mapping[str, array[int]]:
    """By topic, four numbers for each message: both times, offset in the file, and length."""
    places: defaultdict[str, array[int]] = defaultdict(lambda: array("q"))
    for topic, log_ns, publish_ns, offset, data, _ in _of_mcap(file, complain):
        places[topic].extend((log_ns, publish_ns, offset, len(data)))
    return places


_Found = tuple[str, int, int, int, memoryview, bool]
"""Topic, log time, publish time, where in the file the data begin, the data, and whether the
checksum of the part that they are in is right."""


class _Index(NamedTuple):
    """What the summary of an MCAP file says: topics by channel; start and length of each chunk."""

    topics: dict[int, str]
    chunks: list[tuple[int, int]]


def _index_of(file: BinaryIO) -> _Index | None:
    """``None`` where the summary is not as it was written, or knows of no chunk.

    Raises:
        EnvironmentFault: if the chunks are compressed.
    """
    index = _Index({}, [])
    try:
        summary, at = _summary_of(file), 0
        while at + RECORD_HEAD.size <= len(summary):
            kind, size = RECORD_HEAD.unpack_from(summary, at)
            content = summary[at + RECORD_HEAD.size : at + RECORD_HEAD.size + size]
            at += RECORD_HEAD.size + size
            if kind == CHANNEL:
                _add_channel(content, index.topics)
            elif kind == CHUNK_INDEX:
                *_, start, length, offsets = unpack_from("<QQQQI", content)
                _refuse_compressed(file, *unpack_from("<I", content, 36 + offsets + 8))
                index.chunks.append((start, length))
    except (ReaderError, struct_error):
        return None
    size = os.fstat(file.fileno()).st_size
    is_known = all(
        RECORD_HEAD.size + CHUNK_HEAD.size <= length <= size - start
        for start, length in index.chunks
    )
    return index if index.chunks and is_known else None


def _of_mcap(file: BinaryIO, complain: Callable[[str], object]) -> Iterator[_Found]:
    """Chunk by chunk, as the summary has them; without a summary, record by record."""
    index = _index_of(file)
    file.seek(0)
    if not MAGIC.startswith(file.read(len(MAGIC))):  # else it is right, or has been cut off
        complain(f"{file.name} does not begin as an MCAP file")
    if index is None:
        yield from _one_by_one(file, complain)
        return
    kind, size = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
    before = file.tell(), min(start for start, _ in index.chunks)
    if kind != HEADER or size > before[1] - before[0]:
        complain(f"{file.name} is damaged between bytes {before[0]} and {before[1]}")
    for start, length in index.chunks:
        file.seek(start)
        head, content = file.read(RECORD_HEAD.size), file.read(length - RECORD_HEAD.size)
        records = len(content) - CHUNK_HEAD.size
        _, _, size, _, compression, also_size = CHUNK_HEAD.unpack_from(content)
        is_right = _has_checksum(content)
        heads = (*RECORD_HEAD.unpack(head), size, compression, also_size)
        if not is_right or heads != (CHUNK, len(content), records, 0, records):
            complain(f"{file.name} is damaged between bytes {start} and {start + length}")
        yield from _of_chunk(content, start + RECORD_HEAD.size, index.topics, is_right)


def _one_by_one(file: BinaryIO, complain: Callable[[str], object]) -> Iterator[_Found]:
    file_size = os.fstat(file.fileno()).st_size
    topics: dict[int, str] = {}
    while len(head := file.read(RECORD_HEAD.size)) == RECORD_HEAD.size:
        kind, size = RECORD_HEAD.unpack(head)
        offset = file.tell()
        if kind == DATA_END:
            return
        # A damaged length may be any number: no memory is taken for it.
        content = file.read(min(size, file_size - offset))
        if kind == CHUNK:
            whole = content[: CHUNK_HEAD.size + _size_in(content)]
            if len(content) >= CHUNK_HEAD.size:
                _refuse_compressed(file, CHUNK_HEAD.unpack_from(content)[4])
            is_right = _is_as_written(whole)
            if not is_right or len(whole) < len(content):
                complain(f"{file.name} is damaged between bytes {offset} and {file.tell()}")
            file.seek(offset + len(whole))
            yield from _of_chunk(whole, offset, topics, is_right)
        elif size > len(content) and (distance := _next_chunk(content)) is not None:
            complain(f"{file.name} is damaged between bytes {offset} and {offset + distance}")
            file.seek(offset + distance)


def _next_chunk(content: bytes) -> int | None:
    """Where a record after a damaged length is a whole chunk with the right checksum."""
    at = content.find(CHUNK)
    while at >= 0:
        start = at + RECORD_HEAD.size
        if start + CHUNK_HEAD.size > len(content):
            return None
        size = RECORD_HEAD.unpack_from(content, at)[1]
        _, _, records, checksum, *_ = CHUNK_HEAD.unpack_from(content, start)
        is_there = size == CHUNK_HEAD.size + records <= len(content) - start
        if checksum and is_there and _is_as_written(content[start : start + size]):
            return at
        at = content.find(CHUNK, at + 1)
    return None


def _size_in(chunk: bytes) -> int:
    """The length of the records in a chunk without compression, as it says itself."""
    return int(CHUNK_HEAD.unpack_from(chunk)[2]) if len(chunk) >= CHUNK_HEAD.size else 0


def _is_as_written(chunk: bytes) -> bool:
    """Whether the checksum of a chunk is right; a chunk that was cut off counts as that."""
    return len(chunk) < CHUNK_HEAD.size + _size_in(chunk) or _has_checksum(chunk)


def _has_checksum(chunk: bytes) -> bool:
    """Whether the checksum of a whole chunk is right, if it has one."""
    checksum = CHUNK_HEAD.unpack_from(chunk)[3]
    return not checksum or crc32(memoryview(chunk)[CHUNK_HEAD.size :]) == checksum


def _of_chunk(
    content: bytes, offset: int, topics: dict[int, str], is_right: bool
) -> Iterator[_Found]:
    """The messages of a chunk without compression; ``topics`` grows by its channels."""
    if len(content) < CHUNK_HEAD.size:
        return
    at = CHUNK_HEAD.size
    view = memoryview(content)
    while at + RECORD_HEAD.size <= len(content):
        kind, size = RECORD_HEAD.unpack_from(content, at)
        at += RECORD_HEAD.size
        end = at + size
        if end > len(content):
            return
        if kind == CHANNEL:
            _add_channel(content[at:end], topics)
        elif kind == MESSAGE and size >= MESSAGE_HEAD.size:
            number, _, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(content, at)
            start = at + MESSAGE_HEAD.size
            if number in topics and max(log_ns, publish_ns) < 1 << 63:
                data = view[start:end]
                yield topics[number], log_ns, publish_ns, offset + start, data, is_right
        at = end


def _add_channel(record: bytes, topics: dict[int, str]) -> None:
    length = int.from_bytes(record[4:8], "little")
    number = int.from_bytes(record[:2], "little")
    topics.setdefault(number, record[8 : 8 + length].decode(errors="replace"))


def _refuse_compressed(file: BinaryIO, name_length: int) -> None:
    """Raise ``EnvironmentFault`` where the name of a compression is not empty."""
    if name_length:
        raise EnvironmentFault(
            f"{file.name}: its chunks are compressed, which this reader does not read"
        )


def _of_sqlite(
    path: Path, complain: Callable[[str], object], only: str | None = None
) -> Iterator[Stored]:
    query = (
        "SELECT topics.name, timestamp, data FROM messages"
        " JOIN topics ON topics.id = topic_id WHERE ?1 IS NULL OR topics.name = ?1"
        " ORDER BY messages.id"
    )
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection:
        connection.text_factory = partial(str, encoding="utf-8", errors="replace")
        try:
            for topic, log_ns, data in connection.execute(query, (only,)):
                if [type(topic), type(log_ns), type(data)] == [str, int, bytes] and log_ns >= 0:
                    yield Stored(topic, log_ns, log_ns, data)
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:  # texts of errors quote names
            complain(f"{path} is damaged ({error})")
