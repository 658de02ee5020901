"""The messages of a bag, also of one that has lost its end.

An MCAP file is a row of records, each with its length, so it can be read from its beginning as far
as it goes (https://mcap.dev/spec). Libraries begin at its end, where the index is.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from neuros.errors import EnvironmentFault

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_CHANNEL, _MESSAGE_OP, _CHUNK_OP, _DATA_END = 0x04, 0x05, 0x06, 0x0F


class Stored(NamedTuple):
    """A message of a bag; times in nanoseconds."""

    topic: str
    log_ns: int
    publish_ns: int
    data: bytes


def stored_messages(folder: Path, only: str | None = None) -> Iterator[Stored]:
    """All messages in the files of a bag's folder, or those of one topic, as far as they go.

    Raises:
        EnvironmentFault: if they are compressed, which is not how NeuROS records.
    """
    for path in sorted(folder.glob("*.mcap")):
        with open(path, "rb") as file:
            yield from _of_mcap(file, only)
    for path in sorted(folder.glob("*.db3")):
        yield from (each for each in _of_sqlite(path) if only in (None, each.topic))


def is_whole(folder: Path) -> bool:
    """Whether readers will open a bag: it has its metadata, and its files have their ends."""
    if not (folder / "metadata.yaml").is_file():
        return False
    files = [*folder.glob("*.mcap"), *folder.glob("*.db3")]
    return bool(files) and all(path.suffix != ".mcap" or _has_end(path) for path in files)


def _has_end(path: Path) -> bool:
    with open(path, "rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - len(_MAGIC)))
        return size > 2 * len(_MAGIC) and file.read() == _MAGIC


def _of_mcap(file: BinaryIO, only: str | None) -> Iterator[Stored]:
    if file.read(len(_MAGIC)) != _MAGIC:
        return
    topics: dict[int, str] = {}
    while True:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return
        kind, size = _HEAD.unpack(head)
        content = file.read(size)
        if kind == _DATA_END:
            return
        if kind == _CHUNK_OP:
            yield from _of_chunk(content, topics, only)
        if len(content) < size:
            return


def _of_chunk(content: bytes, topics: dict[int, str], only: str | None) -> Iterator[Stored]:
    """The messages of a chunk without compression; ``topics`` grows by its channels."""
    at = _CHUNK.size
    if len(content) < at + 4:
        return
    compression = int.from_bytes(content[at : at + 4], "little")
    if compression:
        raise EnvironmentFault("its chunks are compressed, which this reader does not read")
    at += 4 + 8
    while at + _HEAD.size <= len(content):
        kind, size = _HEAD.unpack_from(content, at)
        at += _HEAD.size
        if at + size > len(content):
            return
        if kind == _CHANNEL:
            length = int.from_bytes(content[at + 4 : at + 8], "little")
            number = int.from_bytes(content[at : at + 2], "little")
            name = content[at + 8 : at + 8 + length].decode()
            if only in (None, name):
                topics[number] = name
        elif kind == _MESSAGE_OP:
            number, _, log_ns, publish_ns = _MESSAGE.unpack_from(content, at)
            if number in topics:
                data = content[at + _MESSAGE.size : at + size]
                yield Stored(topics[number], log_ns, publish_ns, data)
        at += size


def _of_sqlite(path: Path) -> Iterator[Stored]:
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    query = (
        "SELECT topics.name, timestamp, data FROM messages"
        " JOIN topics ON topics.id = topic_id ORDER BY messages.id"
    )
    try:
        for topic, log_ns, data in connection.execute(query):
            yield Stored(topic, log_ns, log_ns, data)
    except sqlite3.DatabaseError:
        return
    finally:
        connection.close()
