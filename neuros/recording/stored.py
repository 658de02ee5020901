"""Reader of the messages of a bag, also of one that has lost its end.

An MCAP file is a row of records, each with its length, so it can be read from its beginning as far
as it goes (https://mcap.dev/spec). Libraries begin at its end, where the index is.
"""

from __future__ import annotations

import os
import sqlite3
import struct
from array import array
from collections.abc import Iterable, Iterator
from contextlib import closing
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


def stored_messages(folder: Path) -> Iterator[Stored]:
    """All messages in the files of a bag's folder, as far as they go.

    Raises:
        EnvironmentFault: if they are compressed, which is not how NeuROS records.
    """
    for path in sorted(folder.glob("*.mcap")):
        with open(path, "rb") as file:
            for topic, log_ns, publish_ns, content, start, end, _ in _of_mcap(file):
                yield Stored(topic, log_ns, publish_ns, content[start:end])
    for path in sorted(folder.glob("*.db3")):
        yield from _of_sqlite(path)


class StoredTopics:
    """The messages of a bag's folder, topic by topic.

    With the first topic an MCAP file is gone through once, and it is noted where each message is:
    32 bytes for one.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._places: dict[Path, dict[str, array[int]]] = {}

    def messages(self, topic: str) -> list[Stored]:
        """Messages of one topic, as far as they go. Raises ``EnvironmentFault`` as above."""
        found: list[Stored] = []
        for path in sorted(self._folder.glob("*.mcap")):
            with open(path, "rb") as file:
                if path in self._places:
                    found += _at(file, topic, self._places[path].get(topic, ()))
                else:
                    self._places[path] = _note_places(file, topic, found)
        for path in sorted(self._folder.glob("*.db3")):
            found += _of_sqlite(path, topic)
        return found


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


_Found = tuple[str, int, int, bytes, int, int, int]
"""Topic, both times, the chunk, where in it a message begins and ends, where the chunk begins."""


def _note_places(file: BinaryIO, wanted: str, messages: list[Stored]) -> dict[str, array[int]]:
    """By topic, four numbers for each message: both times, offset in the file, and length.

    Those of the topic that is wanted go to ``messages`` at once.
    """
    places: dict[str, array[int]] = {}
    for topic, log_ns, publish_ns, content, start, end, offset in _of_mcap(file):
        if topic == wanted:
            messages.append(Stored(topic, log_ns, publish_ns, content[start:end]))
        if topic not in places:
            places[topic] = array("q")
        places[topic].extend((log_ns, publish_ns, offset + start, end - start))
    return places


def _at(file: BinaryIO, topic: str, places: Iterable[int]) -> Iterator[Stored]:
    rows = iter(places)
    for log_ns, publish_ns, start, size in zip(rows, rows, rows, rows, strict=True):
        yield Stored(topic, log_ns, publish_ns, os.pread(file.fileno(), size, start))


def _of_mcap(file: BinaryIO) -> Iterator[_Found]:
    if file.read(len(_MAGIC)) != _MAGIC:
        return
    topics: dict[int, str] = {}
    while True:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return
        kind, size = _HEAD.unpack(head)
        offset = file.tell()
        content = file.read(size)
        if kind == _DATA_END:
            return
        if kind == _CHUNK_OP:
            yield from _of_chunk(content, offset, topics)
        if len(content) < size:
            return


def _of_chunk(content: bytes, offset: int, topics: dict[int, str]) -> Iterator[_Found]:
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
            topics[number] = content[at + 8 : at + 8 + length].decode()
        elif kind == _MESSAGE_OP:
            number, _, log_ns, publish_ns = _MESSAGE.unpack_from(content, at)
            start, end = at + _MESSAGE.size, at + size
            if number in topics:
                yield topics[number], log_ns, publish_ns, content, start, end, offset
        at += size


def _of_sqlite(path: Path, only: str | None = None) -> Iterator[Stored]:
    query = (
        "SELECT topics.name, timestamp, data FROM messages"
        " JOIN topics ON topics.id = topic_id WHERE ?1 IS NULL OR topics.name = ?1"
        " ORDER BY messages.id"
    )
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection:
        try:
            for topic, log_ns, data in connection.execute(query, (only,)):
                yield Stored(topic, log_ns, log_ns, data)
        except sqlite3.DatabaseError:
            return
