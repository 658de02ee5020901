"""Files of bags, MCAP and SQLite, as any version of rosbag2 and other programs write them.

The ``mcap`` library reads MCAP files, since ``rosbags`` gives a message only one time, and needs an
index, which the file of a killed run lacks. Checksums of chunks and of the summary reveal damage.
Python's own library reads SQLite, since ``rosbags`` leaves out what is still in a write-ahead log,
and refuses all topics of a file if it does not know how one of them is described.
"""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from io import BytesIO
from pathlib import Path
from struct import Struct, unpack
from typing import TYPE_CHECKING, BinaryIO, NamedTuple, Protocol
from urllib.parse import quote
from zlib import crc32

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
)
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from neuros.ordinary_files import open_ordinary

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Ros1Reader

SQLITE_MAGIC = b"SQLite format 3\0"
ROS_1_MAGIC = b"#ROSBAG V"
LAST_NS = (1 << 63) - 1
_RECORD_HEAD = Struct("<BQ")  # kind, length
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
_UNKNOWN = "unknown"
"""The type, or the encoding, of a channel that names none."""


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


class FileContents(NamedTuple):
    """Topics of one file, its first and last time, and the ROS distribution, if it names one.

    Without messages, the first time comes after the last.

    Attributes:
        note: a sentence about what is odd, and no damage; empty if nothing is.
    """

    connections: list[Connection]
    start_ns: int
    end_ns: int
    distribution: str = ""
    note: str = ""


class Storage(Protocol):
    """A file of a bag."""

    def contents(self, *, is_complete: bool) -> FileContents:
        """Topics, and how many messages each has.

        Args:
            is_complete: whether a file without its end is damaged; else all of it is read.

        Raises:
            Exception: of any kind, if it is damaged.
        """

    def messages(self, complain: Callable[[str], object], only: str | None) -> Iterator[Stored]:
        """Messages in the order of the file, all or those of one topic.

        Args:
            complain: receives a sentence for each damaged part.
        """


def storage_of(path: Path) -> Storage:
    """The reader of a file, by what it begins with. Raises ``OSError``."""
    with open_ordinary(path) as file:
        begins = file.read(len(SQLITE_MAGIC))
    if begins.startswith(ROS_1_MAGIC):
        return Ros1File(path)
    return SqliteFile(path) if begins == SQLITE_MAGIC else McapFile(path)


_NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")


def connection(
    number: int,
    topic: str,
    kind: str,
    encoding: str,
    definition: MessageDefinition = _NO_DEFINITION,
    count: int = 0,
    profiles: str = "",
) -> Connection:
    """A topic of a file, as ``rosbags`` describes it; ``kind`` is the type of its messages."""
    qos: list[Qos] = []
    with suppress(Exception):  # rosbags raises any for incomplete ones, which nobody needs to read
        qos = parse_qos(profiles)
    ext = ConnectionExtRosbag2(encoding, qos)
    return Connection(number, topic, kind, definition, "", count, ext, None)


# ---------------------------------------------------------------------- SQLite


class SqliteFile:
    """An SQLite file, of any version of its schema (https://github.com/ros2/rosbag2)."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def contents(self, *, is_complete: bool) -> FileContents:
        with closing(self._opened()) as file:
            tables = {row[0] for row in file.execute("SELECT name FROM sqlite_master")}
            if not {"topics", "messages"} <= tables:
                raise ReaderError(f"{self._path.name} lacks the tables of a bag")
            definitions: dict[str, MessageDefinition] = {}
            if "message_definitions" in tables:
                query = "SELECT topic_type, encoding, encoded_message_definition"
                for kind, encoding, text in file.execute(f"{query} FROM message_definitions"):
                    definitions[kind] = _definition(encoding, text)
            counts = dict(file.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"))
            named = {row[1] for row in file.execute("PRAGMA table_info(topics)")}
            qos = "offered_qos_profiles" if "offered_qos_profiles" in named else "''"
            query = f"SELECT id, name, type, serialization_format, {qos} FROM topics ORDER BY id"
            connections = [
                connection(
                    number, topic, kind, encoding, definitions.get(kind, _NO_DEFINITION),
                    counts.get(number, 0), profiles,
                )
                for number, topic, kind, encoding, profiles in file.execute(query)
            ]  # fmt: skip
            query = "SELECT MIN(timestamp), MAX(timestamp) FROM messages"
            first_ns, last_ns = file.execute(query).fetchone()
            row = None
            if "schema" in tables:
                row = file.execute("SELECT ros_distro FROM schema").fetchone()
        if first_ns is None:
            first_ns, last_ns = LAST_NS, 0
        return FileContents(connections, first_ns, last_ns, row[0] if row else "")

    def messages(self, complain: Callable[[str], object], only: str | None) -> Iterator[Stored]:
        query = "SELECT name, timestamp, data FROM messages JOIN topics ON topic_id = topics.id"
        if only is not None:
            query += " WHERE name = ?"
        try:
            with closing(self._opened()) as file:
                rows = file.execute(f"{query} ORDER BY messages.id", () if only is None else [only])
                for topic, log_ns, data in rows:
                    yield Stored(topic, log_ns, log_ns, data)
        except sqlite3.Error as error:
            complain(f"{self._path} is damaged ({error})")

    def _opened(self) -> sqlite3.Connection:
        # Immutable: SQLite makes no file beside it, which a folder may not allow.
        return sqlite3.connect(f"file:{quote(str(self._path))}?mode=ro&immutable=1", uri=True)


def checkpointed(path: Path) -> None:
    """Bring what is in the log beside an SQLite file into the file. Raises ``sqlite3.Error``."""
    with closing(sqlite3.connect(path)) as file:
        file.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        file.execute("SELECT COUNT(*) FROM sqlite_master")
        file.execute("PRAGMA journal_mode=DELETE")


def _definition(encoding: str, text: str) -> MessageDefinition:
    form = _FORMATS.get(encoding)  # a message without fields has an empty text
    return _NO_DEFINITION if form is None else MessageDefinition(form, text)


# ---------------------------------------------------------------------- ROS 1


class Ros1File:
    """A bag of ROS 1, read as what ROS 2 would have recorded: a ``Header`` loses its ``seq``.

    Types of ROS 2 keep its definitions; others are those of the bag, made of types of ROS 2.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._old, self._new = get_typestore(Stores.EMPTY), get_typestore(Stores.LATEST)

    @contextmanager
    def _opened(self) -> Iterator[Ros1Reader]:
        # Imported here: few bags are of ROS 1, and every recorder would wait for it.
        from rosbags.rosbag1 import Reader

        with Reader(self._path) as bag:
            for each in bag.connections:
                types = get_types_from_msg(each.msgdef.data, each.msgtype)
                self._old.register(types)
                known = self._new.fielddefs
                self._new.register({name: types[name] for name in types if name not in known})
            yield bag

    def contents(self, *, is_complete: bool) -> FileContents:
        del is_complete  # rosbags needs the index at the end
        with self._opened() as bag:
            connections = []
            for each in bag.connections:
                text, _ = self._new.generate_msgdef(each.msgtype, ros_version=2)
                definition = MessageDefinition(MessageDefinitionFormat.MSG, text)
                about = each.id, each.topic, each.msgtype, "cdr", definition, each.msgcount
                connections.append(connection(*about))
            if not bag.message_count:
                return FileContents(connections, LAST_NS, 0)
            return FileContents(connections, bag.start_time, bag.end_time)

    def messages(self, complain: Callable[[str], object], only: str | None) -> Iterator[Stored]:
        from rosbags.convert.converter import generate_message_converter

        converters: dict[str, Callable[[bytes], memoryview]] = {}
        try:
            with self._opened() as bag:
                wanted = [each for each in bag.connections if only in (None, each.topic)]
                for each, log_ns, data in bag.messages(wanted) if wanted else ():
                    kind = each.msgtype
                    if kind not in converters:
                        stores = self._old, self._new, kind, kind
                        converters[kind] = generate_message_converter(
                            *stores, {}, src_is2=False, dst_is2=True
                        )
                    yield Stored(each.topic, log_ns, log_ns, bytes(converters[kind](data)))
        except Exception as error:  # rosbags may raise anything for other bytes
            complain(f"{self._path} is damaged ({error})")


# ---------------------------------------------------------------------- MCAP


class McapFile:
    """An MCAP file (https://mcap.dev/spec), with or without an index and an end."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def contents(self, *, is_complete: bool) -> FileContents:
        with open_ordinary(self._path) as file:
            known, note = Summary(), ""
            try:
                known = _summary_of(file)
            except Exception:  # of a damaged file, mcap may raise anything
                if is_complete:
                    raise
                note = f"{self._path.name} has no end: what is there was recorded before"
            # A summary need not repeat all channels and their schemas.
            channels, schemas = known.channels, {0, *known.schemas}
            if (
                (found := known.statistics) is not None
                and channels.keys() >= found.channel_message_counts.keys()
                and all(channel.schema_id in schemas for channel in channels.values())
                and len(channels) == found.channel_count
            ):
                counts: Mapping[int, int] = found.channel_message_counts
                first_ns, last_ns = found.message_start_time, found.message_end_time
                if not found.message_count:
                    first_ns, last_ns = LAST_NS, 0
            else:
                known = Summary()
                counts, first_ns, last_ns = self._counted(file, known)
        names = _names(known)
        connections: dict[str, Connection] = {}
        for channel in known.channels.values():
            schema = known.schemas.get(channel.schema_id)
            definition = _NO_DEFINITION
            if schema is not None:  # that of another encoding may be no text
                definition = _definition(schema.encoding, schema.data.decode(errors="replace"))
            made = connection(
                channel.id,
                names[channel.id],
                schema.name if schema else _UNKNOWN,
                channel.message_encoding or _UNKNOWN,
                definition,
                counts.get(channel.id, 0),
                channel.metadata.get("offered_qos_profiles", ""),
            )
            before = connections.get(made.topic)
            count = made.msgcount + (before.msgcount if before else 0)
            connections[made.topic] = made._replace(msgcount=count)
        return FileContents([*connections.values()], first_ns, last_ns, note=note)

    @staticmethod
    def _counted(file: BinaryIO, known: Summary) -> tuple[Counter[int], int, int]:
        """Messages by channel, and their first and last time, from all of a file."""
        counts, first_ns, last_ns = Counter[int](), LAST_NS, 0
        for record, _ in _messages(file, known, lambda _: None, None, has_index=False):
            counts[record.channel_id] += 1
            first_ns, last_ns = min(first_ns, record.log_time), max(last_ns, record.log_time)
        return counts, first_ns, last_ns

    def messages(self, complain: Callable[[str], object], only: str | None) -> Iterator[Stored]:
        with open_ordinary(self._path) as file:
            try:
                summary, is_whole = _summary_of(file), True
            except Exception:  # of a damaged file, mcap may raise anything
                summary, is_whole = Summary(), False
            names: dict[int, str] = {}
            for record, is_right in _messages(file, summary, complain, only, has_index=is_whole):
                if record.channel_id not in names:
                    names = _names(summary)
                topic = names[record.channel_id]
                if only in (None, topic):
                    times = record.log_time, record.publish_time
                    yield Stored(topic, *times, record.data, not is_right)


def _names(known: Summary) -> dict[int, str]:
    """By channel, the name of its topic, with the type where an earlier channel has another."""
    found: dict[int, str] = {}
    types: dict[str, str] = {}
    for channel in known.channels.values():
        schema = known.schemas.get(channel.schema_id)
        kind = schema.name if schema else _UNKNOWN
        is_same = types.setdefault(channel.topic, kind) == kind
        found[channel.id] = channel.topic if is_same else f"{channel.topic} ({kind})"
    return found


def _summary_of(file: BinaryIO) -> Summary:
    """What the end of an MCAP file repeats: schemas, channels, counts and places of chunks.

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
    if file.read() != MCAP0_MAGIC:
        raise ReaderError(f"{name} has no end")
    file.seek(min(start, end))
    summary = file.read()
    if checksum and crc32(summary[: -len(MCAP0_MAGIC) - 4]) != checksum:
        raise ReaderError(f"the summary of {name} is not what was written")
    if start:
        for record in StreamReader(BytesIO(summary), skip_magic=True).records:
            if isinstance(record, Schema):
                found.schemas[record.id] = record
            elif isinstance(record, Channel):
                found.channels[record.id] = record
            elif isinstance(record, ChunkIndex):
                found.chunk_indexes.append(record)
            elif isinstance(record, Statistics):
                found.statistics = record
    return found


def _messages(
    file: BinaryIO,
    known: Summary,
    complain: Callable[[str], object],
    only: str | None,
    *,
    has_index: bool,
) -> Iterator[tuple[Message, bool]]:
    """Messages, and whether their checksum is right; schemas and channels go to ``known``."""
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
                known.schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                known.channels.setdefault(record.id, record)
            elif (
                isinstance(record, Message)
                and record.channel_id in known.channels
                and max(record.log_time, record.publish_time) <= LAST_NS
            ):
                yield record, is_right


def _indexed(summary: Summary, only: str | None) -> Iterator[tuple[int, int, int]]:
    """Chunks that have the topic: kind of record, start and end in bytes."""
    topics = _names(summary)
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
