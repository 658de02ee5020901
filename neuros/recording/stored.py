"""Reader of bags, also of damaged ones.

The ``mcap`` library reads MCAP files, since ``rosbags`` gives a message only one time, and needs an
index, which the file of a killed run lacks. ``rosbags`` reads all other formats. Checksums of
chunks and of the summary reveal damage.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from io import BytesIO
from pathlib import Path
from struct import Struct, unpack
from textwrap import shorten
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.metadata import parse_qos
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from neuros.errors import EnvironmentFault
from neuros.ordinary_files import open_ordinary
from neuros.project.scanner import read_bytes
from neuros.recording.bag_writer import define, types_of_fields

_RECORD_HEAD = Struct("<BQ")  # kind, length
_BY_MESSAGE = re.compile(rb"compression_mode\W+message\b", re.IGNORECASE)


class Stored(NamedTuple):
    """A message of a bag; times in nanoseconds.

    Attributes:
        may_have_changed: whether the checksum of its part of the file is wrong.
    """

    topic: str
    log_ns: int
    publish_ns: int
    data: bytes
    may_have_changed: bool = False


def stored_messages(
    folder: Path, complain: Callable[[str], object] = lambda _: None, only: str | None = None
) -> Iterator[Stored]:
    """All messages of a bag that can be read.

    Args:
        complain: receives a sentence for each damaged part of a file.
        only: the topic to read; all if ``None``.
    """
    files, metadata = _mcap_files(folder), folder / "metadata.yaml"
    if not files or (metadata.exists() and _BY_MESSAGE.search(read_bytes(metadata))):
        try:
            with opened(folder) as reader, damage_of(folder):
                wanted = [each for each in reader.connections if only in (None, each.topic)]
                for connection, log_ns, data in reader.messages(wanted) if wanted else ():
                    yield Stored(connection.topic, log_ns, log_ns, data)
        except EnvironmentFault as error:
            complain(str(error))
        return
    for path in files:
        with open_ordinary(path) as file:
            try:
                summary, is_whole = _summary_of(file), True
            except Exception:  # of a damaged file, mcap may raise anything
                summary, is_whole = Summary(), False
            yield from _of_mcap(file, summary, complain, only, has_index=is_whole)


def faults_of(folder: Path, counts: Mapping[str, int]) -> list[str]:
    """A sentence for each damage of a bag; reads all of it.

    Args:
        counts: by topic, how many messages the bag should have.
    """
    faults: list[str] = []
    found = Counter(message.topic for message in stored_messages(folder, faults.append))
    return faults or [
        are_left(folder, name, count, found[name])
        for name, count in counts.items()
        if found[name] < count
    ]


def are_left(folder: Path, topic: str, count: int, left: int) -> str:
    """A sentence on missing messages."""
    return f"{folder}: of {count} packets of {topic} {left} are left"


def is_whole(folder: Path) -> bool:
    """Whether metadata, types, beginning and end of the files of a bag can be read."""
    try:
        with opened(folder) as reader, damage_of(folder):
            store_of(reader.connections)
            return True
    except EnvironmentFault:
        return False


class Contents(NamedTuple):
    """Topics and times of a bag, and the custom data of its metadata."""

    connections: list[Connection]
    start_ns: int
    duration_ns: int
    custom: dict[str, str]


def contents_of(folder: Path) -> Contents:
    """Read the metadata and index of a bag; of a bag that was cut off, all of its file.

    Raises:
        EnvironmentFault: if it cannot be read.
    """
    if (folder / "metadata.yaml").exists() or not _mcap_files(folder):
        with opened(folder) as reader, damage_of(folder):
            custom = dict(reader.storage.metadata.custom or {})
            return Contents([*reader.connections], reader.start_time, reader.duration, custom)
    known, counts, first_ns, last_ns = Summary(), Counter[str](), (1 << 63) - 1, 0
    for path in _mcap_files(folder):
        with open_ordinary(path) as file:
            for message in _of_mcap(file, known, lambda _: None, None, has_index=False):
                counts[message.topic] += 1
                first_ns, last_ns = min(first_ns, message.log_ns), max(last_ns, message.log_ns)
    with damage_of(folder):
        connections = [
            Connection(
                channel.id,
                channel.topic,
                known.schemas[channel.schema_id].name,
                MessageDefinition(
                    MessageDefinitionFormat.MSG, known.schemas[channel.schema_id].data.decode()
                ),
                "",
                counts[channel.topic],
                ConnectionExtRosbag2("cdr", parse_qos(channel.metadata["offered_qos_profiles"])),
                None,
            )
            for channel in known.channels.values()
        ]
    return Contents(connections, first_ns, max(0, last_ns - first_ns), {})


@contextmanager
def opened(folder: Path) -> Iterator[Reader]:
    """Open a bag with ``rosbags``.

    Raises:
        EnvironmentFault: if that fails.
    """
    with ExitStack() as stack:
        with damage_of(folder):
            for path in folder.glob("*"):
                if path.suffix in (".mcap", ".db3", ".yaml"):
                    with open_ordinary(path) as file:
                        if path.suffix == ".mcap":
                            _summary_of(file)
            reader = Reader(folder)
            reader.open()
            stack.callback(reader.close)
            _check_definitions(reader)
        yield reader


def store_of(connections: Iterable[Connection]) -> Typestore:
    """The types that a bag defines; types without a definition (before Iron) as installed.

    Raises:
        EnvironmentFault: if a type is neither defined nor installed.
        ReaderError: if a definition lacks the type of a field.
        Exception: of any kind, if a definition cannot be parsed.
    """
    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    for connection in connections:
        if connection.msgdef.format == MessageDefinitionFormat.NONE:
            define(connection.msgtype, store)
        else:
            types |= get_types_from_msg(connection.msgdef.data, connection.msgtype)
    store.register(types)
    for name, (_, fields) in types.items():
        if unknown := next((used for used in types_of_fields(fields) if used not in types), None):
            raise ReaderError(f"it does not define {unknown}, which {name} has")
    return store


@contextmanager
def damage_of(folder: Path, what: str = "") -> Iterator[None]:
    """Turn any exception of ``rosbags`` into ``EnvironmentFault``.

    Args:
        what: the part of the bag that is read; empty: all of it.
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
        folder.files = []  # close() needs a list
        raise ReaderError("in metadata.yaml, files is no list")
    storages = folder.storages if folder else ()
    stored = [each for storage in storages for each in storage.connections]
    there = {(each.topic, each.msgtype) for each in stored}
    named = {each.topic for each in reader.connections}
    if unnamed := next((e.topic for e in stored if e.msgcount and e.topic not in named), ""):
        raise ReaderError(f"metadata.yaml does not name the topic {unnamed}, which its files have")
    for connection in reader.connections:
        if type(connection.msgcount) is not int or connection.msgcount < 0:
            raise ReaderError(f"{connection.topic} has {connection.msgcount} packets")
        if connection.msgcount and (connection.topic, connection.msgtype) not in there:
            what = f"{connection.topic} of type {connection.msgtype}"
            raise ReaderError(f"its files do not have the topic {what}")


def _mcap_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"))


def _summary_of(file: BinaryIO) -> Summary:
    """Channels and chunk indexes of an MCAP file.

    Raises:
        ReaderError: if the file has lost its end, or the checksum of the summary is wrong.
        Exception: of any kind, if it is damaged and has no checksum.
    """
    name, found = Path(file.name).name, Summary()
    end = file.seek(0, os.SEEK_END) - len(MCAP0_MAGIC) - 4
    if end < 16:
        raise ReaderError(f"{name} has no end")
    file.seek(end - 16)
    start, _, checksum = unpack("<QQI", file.read(20))
    file.seek(min(start, end))
    summary = file.read()
    if checksum and crc32(summary[: -len(MCAP0_MAGIC) - 4]) != checksum:
        raise ReaderError(f"the summary of {name} is not what was written")
    if start:
        for record in StreamReader(BytesIO(summary), skip_magic=True).records:
            if isinstance(record, Channel):
                found.channels[record.id] = record
            elif isinstance(record, ChunkIndex):
                found.chunk_indexes.append(record)
    return found


def _of_mcap(
    file: BinaryIO,
    known: Summary,
    complain: Callable[[str], object],
    only: str | None,
    *,
    has_index: bool,
) -> Iterator[Stored]:
    """Messages in the order of the file; schemas and channels are added to ``known``."""
    file.seek(0)
    if not MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC))):  # shorter: it was cut off
        complain(f"{file.name} does not begin as an MCAP file")
    is_indexed = has_index and bool(known.chunk_indexes)
    for kind, start, end in _indexed(known, only) if is_indexed else _one_by_one(file):
        records, is_right = _records_of(kind, file, start, end)
        if not is_right:
            complain(f"{file.name} is damaged between bytes {start} and {end}")
        for record in records:
            if isinstance(record, Schema):
                known.schemas[record.id] = record
            elif isinstance(record, Channel):
                known.channels.setdefault(record.id, record)
            elif isinstance(record, Message) and record.channel_id in known.channels:
                topic, publish_ns = known.channels[record.channel_id].topic, record.publish_time
                is_time = max(record.log_time, publish_ns) < 1 << 63
                if is_time and only in (None, topic):
                    yield Stored(topic, record.log_time, publish_ns, record.data, not is_right)


def _indexed(summary: Summary, only: str | None) -> Iterator[tuple[int, int, int]]:
    """Chunks that have the topic: kind of record, start and end in bytes."""
    topics = {channel.id: channel.topic for channel in summary.channels.values()}
    for index in summary.chunk_indexes:
        # Without an index of its messages, a chunk may have any topic.
        there = {topics.get(each) for each in index.message_index_offsets} or {only}
        if only is None or only in there:
            start = index.chunk_start_offset
            yield Opcode.CHUNK, start, start + index.chunk_length


def _one_by_one(file: BinaryIO) -> Iterator[tuple[int, int, int]]:
    """Whole chunks, and records outside of chunks: kind, start and end in bytes."""
    at, size = len(MCAP0_MAGIC), os.fstat(file.fileno()).st_size
    while at + _RECORD_HEAD.size <= size:
        file.seek(at)
        kind, length = _RECORD_HEAD.unpack(file.read(_RECORD_HEAD.size))
        end = at + _RECORD_HEAD.size + length
        if end > size or kind == Opcode.DATA_END:
            return
        if kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
            yield kind, at, end
        at = end


def _records_of(kind: int, file: BinaryIO, start: int, end: int) -> tuple[list[McapRecord], bool]:
    """A record, or those of a chunk, and whether its checksum is right."""
    try:
        file.seek(start + _RECORD_HEAD.size)
        size = min(end, os.fstat(file.fileno()).st_size) - file.tell()
        stream = ReadDataStream(BytesIO(file.read(size)))
        if kind == Opcode.MESSAGE:
            return [Message.read(stream, size)], True
        if kind != Opcode.CHUNK:
            return [Schema.read(stream) if kind == Opcode.SCHEMA else Channel.read(stream)], True
        chunk = Chunk.read(stream)
        try:
            return breakup_chunk(chunk, validate_crc=True), True
        except CRCValidationError:
            return breakup_chunk(chunk), False
    except Exception:  # the library may raise anything for other bytes
        return [], False
