"""Writer of a rosbag2 folder that is complete on the disk at every checkpoint.

``rosbags`` writes the index of an MCAP file and ``metadata.yaml`` when it closes a bag; a bag that
was never closed does not open. Here every checkpoint closes it, as far as its readers can tell, and
the next one writes over the end of the former. So whatever happens in between, also a SIGKILL,
leaves the bag of the last checkpoint. Besides, each message has two times: ``rosbags`` takes one.

A bag holds the definitions of its message types, so that it can be read where they are not.
"""

from __future__ import annotations

import errno
import importlib.util
import os
import struct
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, cast

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from neuros.errors import EnvironmentFault
from neuros.recording.plan import Topic


class Definitions:
    """The definitions of message types: those that come with ROS, and what is installed here."""

    def __init__(self) -> None:
        self.store: Typestore = get_typestore(Stores.ROS2_JAZZY)

    def add(self, type_name: str) -> None:
        """See to it that the store has a type, and all types of its fields.

        Raises:
            EnvironmentFault: if no definition of one of them is found.
        """
        if type_name in self.store.fielddefs:
            return
        path = _file_of(type_name)
        if path is None:
            raise EnvironmentFault(
                f"message type {type_name} cannot be recorded: its definition"
                f" (share/{type_name}.msg) is not installed here"
            )
        types = get_types_from_msg(path.read_text("utf-8"), type_name)
        for used in _types_of_fields(types[type_name][1]):
            if used.endswith("/msg/wstring"):
                raise EnvironmentFault(
                    f"message type {type_name} cannot be recorded: it has a wstring, which the"
                    " library that writes bags does not know; use string, which is UTF-8"
                )
            if used != type_name:
                self.add(used)
        self.store.register(types)


def _file_of(type_name: str) -> Path | None:
    """The definition: the share folder is some folders above an installed message package."""
    try:
        spec = importlib.util.find_spec(type_name.split("/")[0])
    except (ImportError, ValueError):
        spec = None
    for location in (spec.submodule_search_locations or ()) if spec else ():
        for folder in Path(location).parents:
            path = folder / "share" / f"{type_name}.msg"
            if path.is_file():
                return path
    return None


def _types_of_fields(fields: object) -> list[str]:
    """The message types in rosbags' description of fields."""
    found: list[str] = []
    if isinstance(fields, str):
        if "/" in fields:
            found.append(fields)
    elif isinstance(fields, (list, tuple)):
        for part in fields:
            found += _types_of_fields(part)
    return found


# Opcode, length, channel, number within the channel, log time, publish time.
_MESSAGE = struct.Struct("<BQHIQQ")
_WITHOUT_DATA = 22
_CHUNK_BYTES = 1 << 20
_FOREVER = QosTime(9223372036, 854775807)  # as rmw has it for "no deadline"


class _Tail(BytesIO):
    """The end of a file, not written yet, which begins at ``start``."""

    def __init__(self, start: int) -> None:
        super().__init__()
        self.start = start

    def tell(self) -> int:
        return self.start + super().tell()

    def close(self) -> None:
        """Its content is still needed."""


class CheckedMcap(McapWriter):
    """An MCAP file that is complete whenever :meth:`close` has returned, and goes on after it."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        self.bio.flush()
        self._file = self.bio
        self._new = _Tail(os.fstat(self._file.fileno()).st_size)
        self.bio = cast(Any, self._new)
        self._end = b""

    @property
    def pending_bytes(self) -> int:
        """Bytes that wait for the next checkpoint."""
        return self._new.tell() - self._new.start + self.chunk.bio.tell()

    def put(self, connection: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message."""
        chunk, bio = self.chunk, self.chunk.bio
        chunk.msgs[connection].append((log_ns, bio.tell()))
        if log_ns < chunk.message_start_time:
            chunk.message_start_time = log_ns
            self.message_start_time = min(log_ns, self.message_start_time)
        if log_ns > chunk.message_end_time:
            chunk.message_end_time = log_ns
            self.message_end_time = max(log_ns, self.message_end_time)
        number = self.channel_stats[connection] = self.channel_stats[connection] + 1
        size = _WITHOUT_DATA + len(data)
        bio.write(_MESSAGE.pack(5, size, connection, number & 0xFFFFFFFF, log_ns, publish_ns))
        bio.write(data)
        if bio.tell() > _CHUNK_BYTES:
            self._close_chunk()

    def close(self, version: int, metadata: str) -> None:
        """Make the file complete. Raises ``OSError``; it is as it was then."""
        if self.chunk.bio.tell():
            self._close_chunk()
        self.bio = cast(Any, _Tail(self._new.tell()))
        super().close(version, metadata)
        end = cast(_Tail, self.bio).getvalue()
        try:
            self._write(self._new.getvalue() + end)
        except OSError:
            self._write(self._end)  # there was room for it before
            raise
        finally:
            self.bio = cast(Any, self._new)
        self._end = end
        self._new = _Tail(self._new.tell())
        self.bio = cast(Any, self._new)

    def shut(self) -> None:
        """Write nothing any more."""
        self._file.close()

    def _close_chunk(self) -> None:
        if not self.chunk.msgs:  # schemas and channels alone
            self.chunk.message_start_time = 0
        self.close_chunk()

    def _write(self, data: bytes) -> None:
        descriptor, at = self._file.fileno(), self._new.start
        left = memoryview(data)
        while left:
            written = os.pwrite(descriptor, left, at)
            left, at = left[written:], at + written
        os.ftruncate(descriptor, at)


class CheckedSqlite(Sqlite3Writer):
    """An SQLite file that is complete whenever :meth:`close` has returned, and goes on after it.

    It has one time per message, that of the log.
    """

    pending_bytes = 0

    def put(self, connection: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message."""
        self.pending_bytes += len(data)
        self.cursor.execute(
            "INSERT INTO messages (topic_id, timestamp, data) VALUES(?, ?, ?)",
            (connection, log_ns, data),
        )

    def close(self, version: int, metadata: str) -> None:
        """Make the file complete."""
        self.cursor.execute("DELETE FROM metadata")
        self.cursor.execute(
            "INSERT INTO metadata(metadata_version, metadata) VALUES(?, ?)", (version, metadata)
        )
        self.conn.commit()
        self.pending_bytes = 0

    def shut(self) -> None:
        """Write nothing any more."""
        self.conn.close()


class BagWriter(Writer):
    """Writes a bag; between two checkpoints nothing of it can be seen.

    Args:
        path: the folder of the bag, which must not exist.
        storage: ``mcap`` or ``sqlite3``.
        custom: what its metadata says besides.

    Raises:
        OSError: if it cannot be written.
    """

    STORAGE_PLUGINS: Mapping[StoragePlugin, Any] = {
        StoragePlugin.MCAP: CheckedMcap,
        StoragePlugin.SQLITE3: CheckedSqlite,
    }

    def __init__(self, path: Path, storage: str, custom: Mapping[str, str]) -> None:
        super().__init__(
            path,
            version=Writer.VERSION_LATEST,
            storage_plugin=StoragePlugin[storage.upper()],
        )
        for key, value in custom.items():
            self.set_custom_data(key, value)
        try:
            self.open()
        except WriterError as error:
            raise OSError(errno.EEXIST, f"{path} exists already") from error

    def add_topic(self, topic: Topic, definitions: Definitions) -> int:
        """The number of a new topic, for :meth:`put`. Raises ``EnvironmentFault``."""
        definitions.add(topic.type)
        connection: Connection = self.add_connection(
            topic.name,
            topic.type,
            typestore=definitions.store,
            offered_qos_profiles=[_qos(topic)],
        )
        return connection.id

    def put(self, topic: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message; times in nanoseconds."""
        cast(Any, self.storage).put(topic, log_ns, publish_ns, data)
        self.counts[topic] += 1
        if log_ns < self.min_timestamp:
            self.min_timestamp = log_ns
        if log_ns > self.max_timestamp:
            self.max_timestamp = log_ns

    @property
    def pending_bytes(self) -> int:
        """Bytes that the next checkpoint has to write."""
        return int(cast(Any, self.storage).pending_bytes)

    def checkpoint(self) -> None:
        """Make the bag on the disk complete. Raises ``OSError``."""
        storage = self.storage
        try:
            super().close()
        finally:
            self.storage = storage

    def close(self) -> None:
        """Make it complete, and write nothing any more. Raises ``OSError``."""
        try:
            self.checkpoint()
        finally:
            self.shut()

    def shut(self) -> None:
        """Leave it as the last checkpoint has made it."""
        storage, self.storage = cast(Any, self.storage), None
        if storage is not None:
            storage.shut()


def _qos(topic: Topic) -> Qos:
    """The quality of service that the sender of a topic offers."""
    latched = QosDurability.TRANSIENT_LOCAL
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=topic.depth,
        reliability=QosReliability.RELIABLE if topic.is_reliable else QosReliability.BEST_EFFORT,
        durability=latched if topic.is_latched else QosDurability.VOLATILE,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )
