"""Files of a bag, which are complete on the disk after every checkpoint.

``rosbags`` writes the index of an MCAP file and ``metadata.yaml`` when it closes a bag, gives a
message one time, and begins to read at the index. Here a checkpoint writes index and metadata, and
the next one writes over the end of the former: whatever happens in between, also a SIGKILL, leaves
the bag of the last checkpoint. A message has two times, and a file that has lost its end is read
from its beginning.

MCAP is a row of records, each with its length (https://mcap.dev/spec). A bag holds the definitions
of its message types, so that it can be read where they are not installed.
"""

from __future__ import annotations

import errno
import json
import os
import sqlite3
from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from struct import Struct, pack
from typing import Any
from zlib import crc32

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from neuros.distribution import __version__
from neuros.errors import EnvironmentFault
from neuros.ordinary_files import folder_in, write_whole
from neuros.project.message_types import message_folder, normalised
from neuros.recording.recording_plan import Topic

_CHUNK_BYTES = 1 << 20
MAGIC = b"\x89MCAP0\r\n"
HEADER, _FOOTER, _SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06
_MESSAGE_INDEX, CHUNK_INDEX, _STATISTICS, _METADATA, _METADATA_INDEX = 0x07, 0x08, 0x0B, 0x0C, 0x0D
_SUMMARY_OFFSET, DATA_END = 0x0E, 0x0F
RECORD_HEAD = Struct("<BQ")  # kind, length
MESSAGE_HEAD = Struct("<HIQQ")  # channel, number within the channel, log time, publish time
_MESSAGE_RECORD = Struct("<BQHIQQ")  # both
# First and last log time, size and checksum of the records; no compression, size once more.
CHUNK_HEAD = Struct("<QQQIIQ")
_LAST_NS = (1 << 63) - 1
_FOREVER = {"sec": 9223372036, "nsec": 854775807}  # as rmw has it for "no deadline"


def _define(type_name: str, store: Typestore) -> None:
    """Add an installed type to the store, and all types of its fields.

    Raises:
        EnvironmentFault: if no definition of one of them is found.
    """
    if type_name in store.fielddefs:
        return
    is_type = normalised(type_name) == type_name
    folder = message_folder(type_name.split("/")[0]) if is_type else None
    # The share folder is some folders above.
    shares = (above / "share" / f"{type_name}.msg" for above in folder.parents) if folder else ()
    path = next(filter(Path.is_file, shares), None)
    if path is None:
        raise EnvironmentFault(
            f"message type {type_name} cannot be recorded: its definition"
            f" (share/{type_name}.msg) is not installed here"
        )
    types = get_types_from_msg(path.read_text("utf-8"), type_name)
    for used in types_of_fields(types[type_name][1]):
        if used.endswith("/msg/wstring"):
            raise EnvironmentFault(
                f"message type {type_name} cannot be recorded: it has a wstring, which the"
                " library that writes bags does not know; use string, which is UTF-8"
            )
        if used != type_name:
            _define(used, store)
    store.register(types)


def types_of_fields(fields: object) -> Iterator[str]:
    """The message types in rosbags' description of fields."""
    if isinstance(fields, str):
        if "/" in fields:
            yield fields
    elif isinstance(fields, (list, tuple)):
        for part in fields:
            yield from types_of_fields(part)


class BagWriter:
    """Writes a bag (rosbag2, version 9); between two checkpoints nothing of it can be seen.

    Args:
        path: the folder of the bag, which must not exist.
        storage: ``mcap`` or ``sqlite3``, which has no publish time.
        custom: what its metadata says besides.

    Attributes:
        counts: by number of the topic, the messages.

    Raises:
        OSError: if it cannot be written.
    """

    def __init__(self, path: Path, storage: str, custom: Mapping[str, str]) -> None:
        try:
            path.mkdir(parents=True)
        except FileExistsError as error:
            raise OSError(errno.EEXIST, f"{path} exists already") from error
        self.counts: dict[int, int] = {}
        self._path, self._storage, self._custom = path, storage, dict(custom)
        with self._folder() as folder:
            self._file = (
                _McapFile(folder / f"{path.name}.mcap")
                if storage == "mcap"
                # SQLite makes and removes a journal beside it, by the name of its folder.
                else _SqliteFile(path / f"{path.name}.db3")
            )
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._topics: list[dict[str, Any]] = []
        self._first_ns, self._last_ns = _LAST_NS, 0

    def add_topic(self, topic: Topic) -> int:
        """The number of a new topic, for :meth:`put`.

        Raises:
            EnvironmentFault: if the definition of its type is not installed.
        """
        _define(topic.type, self._types)
        definition, _ = self._types.generate_msgdef(topic.type, ros_version=2)
        digest = self._types.hash_rihs01(topic.type)
        number = len(self._topics) + 1
        self._file.add_topic(number, topic, definition, digest)
        self.counts[number] = 0
        self._topics.append(
            {
                "name": topic.name,
                "type": topic.type,
                "serialization_format": "cdr",
                "offered_qos_profiles": _qos_profiles(topic),
                "type_description_hash": digest,
            }
        )
        return number

    def put(self, topic: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message; times in nanoseconds."""
        self._file.put(topic, log_ns, publish_ns, data)
        self.counts[topic] += 1
        if log_ns < self._first_ns:
            self._first_ns = log_ns
        if log_ns > self._last_ns:
            self._last_ns = log_ns

    @property
    def pending_bytes(self) -> int:
        """Bytes that the next checkpoint has to write."""
        return self._file.pending_bytes

    def checkpoint(self) -> None:
        """Make the bag on the disk complete. Raises ``OSError``."""
        information = self._information()
        self._file.checkpoint(_yaml(information))
        text = _yaml({"rosbag2_bagfile_information": information})
        with self._folder() as folder:
            write_whole(folder / "metadata.yaml", f"{text}\n".encode())

    def close(self) -> None:
        """Make it complete, and write nothing any more. Raises ``OSError``."""
        try:
            self.checkpoint()
        finally:
            self.shut()

    def shut(self) -> None:
        """Leave it as the last checkpoint has made it."""
        self._file.shut()

    def _folder(self) -> AbstractContextManager[Path]:
        return folder_in(self._path.parent, self._path.name)

    def _information(self) -> dict[str, Any]:
        content = {
            "starting_time": {"nanoseconds_since_epoch": self._first_ns},
            "duration": {"nanoseconds": max(0, self._last_ns - self._first_ns)},
            "message_count": sum(self.counts.values()),
        }
        return {
            "version": 9,
            "storage_identifier": self._storage,
            "relative_file_paths": [self._file.path.name],
            **content,
            "topics_with_message_count": [
                {"topic_metadata": topic, "message_count": self.counts[number]}
                for number, topic in enumerate(self._topics, 1)
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": self._file.path.name, **content}],
            "custom_data": self._custom or None,
            "ros_distro": "jazzy",
        }


def _yaml(content: Any) -> str:
    """JSON, which is YAML, and 30 times as fast to write."""
    return json.dumps(content, indent=1, ensure_ascii=False)


def _qos_profiles(topic: Topic) -> list[dict[str, Any]]:
    """The quality of service that the sender of a topic offers."""
    return [
        {
            "history": "keep_last",
            "depth": topic.depth,
            "reliability": "reliable" if topic.is_reliable else "best_effort",
            "durability": "transient_local" if topic.is_latched else "volatile",
            "deadline": _FOREVER,
            "lifespan": _FOREVER,
            "liveliness": "automatic",
            "liveliness_lease_duration": _FOREVER,
            "avoid_ros_namespace_conventions": False,
        }
    ]


class _McapFile:
    """An MCAP file: chunks with the messages, then the summary, which the next chunk replaces."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._safe_bytes = 0  # without the summary, that of the last checkpoint
        self._summary = b""
        self._size = 0  # with all that is pending
        self._pending: list[bytes] = []
        self._add(MAGIC, _record(HEADER, _text("ros2"), _text(f"neuros-{__version__}")))
        self._chunk: list[bytes] = []
        self._chunk_size = 0
        self._schemas: dict[str, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._counts: dict[int, int] = {}
        # By channel, log time and place in the chunk of each message, one after the other.
        self._places: defaultdict[int, array[int]] = defaultdict(lambda: array("Q"))
        self._chunk_indexes: list[bytes] = []
        self._first_ns, self._last_ns = _LAST_NS, 0

    @property
    def pending_bytes(self) -> int:
        return self._size - self._safe_bytes + self._chunk_size

    def add_topic(self, number: int, topic: Topic, definition: str, digest: str) -> None:
        if topic.type not in self._schemas:
            head = pack("<H", len(self._schemas) + 1)
            texts = _text(topic.type), _text("ros2msg"), _text(definition)
            self._schemas[topic.type] = _record(_SCHEMA, head, *texts)
            self._add_to_chunk(self._schemas[topic.type])
        self._channels[number] = _record(
            CHANNEL,
            pack("<HH", number, [*self._schemas].index(topic.type) + 1),
            _text(topic.name),
            _text("cdr"),
            _text(_text("offered_qos_profiles") + _text(_yaml(_qos_profiles(topic)))),
        )
        self._add_to_chunk(self._channels[number])
        self._counts[number] = 0

    def put(self, topic: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        self._places[topic].extend((log_ns, self._chunk_size))
        number = self._counts[topic] = self._counts[topic] + 1
        size = MESSAGE_HEAD.size + len(data)
        number &= 0xFFFFFFFF
        head = _MESSAGE_RECORD.pack(MESSAGE, size, topic, number, log_ns, publish_ns)
        self._add_to_chunk(head, data)
        if self._chunk_size > _CHUNK_BYTES:
            self._close_chunk()

    def checkpoint(self, metadata: str) -> None:
        """Make the file complete. Raises ``OSError``; it is as it was then."""
        if self._chunk:
            self._close_chunk()
        summary = self._new_summary(metadata)
        try:
            self._write(b"".join((*self._pending, summary)))
        except OSError:
            self._write(self._summary)  # there was room for it before
            raise
        self._summary = summary
        self._safe_bytes = self._size
        self._pending.clear()

    def shut(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _add(self, *parts: bytes) -> None:
        self._pending += parts
        self._size += sum(map(len, parts))

    def _add_to_chunk(self, *parts: bytes) -> None:
        self._chunk += parts
        self._chunk_size += sum(map(len, parts))

    def _close_chunk(self) -> None:
        times = [ns for places in self._places.values() for ns in places[::2]]
        first_ns, last_ns = min(times, default=0), max(times, default=0)
        if times:
            self._first_ns = min(self._first_ns, first_ns)
            self._last_ns = max(self._last_ns, last_ns)
        start, size = self._size, self._chunk_size
        checksum = 0
        for part in self._chunk:
            checksum = crc32(part, checksum)
        head = CHUNK_HEAD.pack(first_ns, last_ns, size, checksum, 0, size)
        self._add(RECORD_HEAD.pack(CHUNK, len(head) + size), head, *self._chunk)
        length = self._size - start
        offsets = b""
        for channel, places in self._places.items():
            offsets += pack("<HQ", channel, self._size)
            index = pack(f"<HI{len(places)}Q", channel, 8 * len(places), *places)
            self._add(_record(_MESSAGE_INDEX, index))
        self._chunk_indexes.append(
            _record(
                CHUNK_INDEX,
                pack("<QQQQ", first_ns, last_ns, start, length),
                _text(offsets),
                pack("<Q", self._size - start - length),
                _text(""),
                pack("<QQ", size, size),
            )
        )
        self._chunk.clear()
        self._chunk_size = 0
        self._places.clear()

    def _new_summary(self, metadata: str) -> bytes:
        """All that follows the chunks."""
        name = _text("rosbag2")
        pairs = _text(_text("serialized_metadata") + _text(metadata))
        metadata_record = _record(_METADATA, name, pairs)
        before = metadata_record + _record(DATA_END, pack("<I", 0))
        place = pack("<QQ", self._size, len(metadata_record))
        counts = b"".join(pack("<HQ", *each) for each in self._counts.items())
        number = sum(self._counts.values())
        sizes = len(self._schemas), len(self._channels), 0, 1, len(self._chunk_indexes)
        statistics = pack("<QHIIIIQQ", number, *sizes, self._first_ns, self._last_ns)
        start = self._size + len(before)
        summary, offsets = b"", b""
        for kind, records in (
            (_SCHEMA, self._schemas.values()),
            (CHANNEL, self._channels.values()),
            (CHUNK_INDEX, self._chunk_indexes),
            (_METADATA_INDEX, [_record(_METADATA_INDEX, place, name)]),
            (_STATISTICS, [_record(_STATISTICS, statistics, _text(counts))]),
        ):
            group = b"".join(records)
            if group:
                where = pack("<BQQ", kind, start + len(summary), len(group))
                offsets += _record(_SUMMARY_OFFSET, where)
                summary += group
        footer = RECORD_HEAD.pack(_FOOTER, 20) + pack("<QQ", start, start + len(summary))
        checksum = pack("<I", crc32(summary + offsets + footer))
        return before + summary + offsets + footer + checksum + MAGIC

    def _write(self, data: bytes) -> None:
        at = self._safe_bytes
        left = memoryview(data)
        while left:
            written = os.pwrite(self._descriptor, left, at)
            left, at = left[written:], at + written
        os.ftruncate(self._descriptor, at)


def _record(kind: int, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return RECORD_HEAD.pack(kind, len(content)) + content


def _text(content: str | bytes) -> bytes:
    """A string, or an array or map of MCAP: the length and the content."""
    data = content.encode() if isinstance(content, str) else content
    return pack("<I", len(data)) + data


class _SqliteFile:
    """An SQLite file of rosbag2."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.pending_bytes = 0
        self._connection = sqlite3.connect(self.path)
        self._types: set[str] = set()
        self._connection.executescript(
            """
            CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
            CREATE TABLE metadata(
              id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
            CREATE TABLE topics(
              id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
              serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,
              type_description_hash TEXT NOT NULL);
            CREATE TABLE message_definitions(
              id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
              encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
            CREATE TABLE messages(
              id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
              data BLOB NOT NULL);
            CREATE INDEX timestamp_idx ON messages (timestamp ASC);
            INSERT INTO schema(schema_version, ros_distro) VALUES (4, 'jazzy');
            """
        )

    def add_topic(self, number: int, topic: Topic, definition: str, digest: str) -> None:
        qos = _yaml(_qos_profiles(topic))
        self._insert("topics", number, topic.name, topic.type, "cdr", qos, digest)
        if topic.type not in self._types:
            self._types.add(topic.type)
            self._insert("message_definitions", None, topic.type, "ros2msg", definition, digest)

    def put(self, topic: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        self.pending_bytes += len(data)
        self._insert("messages", None, topic, log_ns, data)

    def checkpoint(self, metadata: str) -> None:
        self._execute("DELETE FROM metadata")
        self._insert("metadata", None, 9, metadata)
        self._execute("COMMIT")
        self.pending_bytes = 0

    def shut(self) -> None:
        self._connection.close()

    def _insert(self, table: str, *values: Any) -> None:
        places = ", ".join("?" * len(values))
        self._execute(f"INSERT INTO {table} VALUES({places})", values)

    def _execute(self, statement: str, values: Sequence[Any] = ()) -> None:
        try:
            self._connection.execute(statement, values)
        except sqlite3.Error as error:  # the disk is full, say
            raise OSError(errno.EIO, str(error)) from error
