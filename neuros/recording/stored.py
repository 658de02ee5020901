"""Reader of bags: of NeuROS, of every version of rosbag2, of ROS 1 and others; also damaged ones.

A bag is a folder, with ``metadata.yaml`` or without, or a single file; its files are of any storage
(:mod:`neuros.recording.storages`), compressed as a whole, by chunk or by message, or not at all.
"""

from __future__ import annotations

import shutil
import sys
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path, PurePath
from tempfile import mkdtemp
from textwrap import shorten
from typing import NamedTuple

from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import Connection
from rosbags.rosbag2 import ReaderError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from neuros.errors import EnvironmentFault, UsageError
from neuros.ordinary_files import open_ordinary
from neuros.project.scanner import read_bytes
from neuros.recording.storages import (
    LAST_NS,
    ROS_1_MAGIC,
    SQLITE_MAGIC,
    Storage,
    Stored,
    checkpointed,
    connection,
    storage_of,
)
from neuros.recording.topic_types import TopicType

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

METADATA_NAME = "metadata.yaml"
_SUFFIXES = (".mcap", ".db3", ".bag", ".mcap.zstd", ".db3.zstd")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_DISTRIBUTIONS = {1: "dashing", 2: "dashing", 3: "eloquent", 4: "foxy", 5: "humble"}
"""ROS distribution by the version of the metadata; later ones name it."""


class _Metadata(NamedTuple):
    """What is used of ``metadata.yaml``: names of files, and type and messages of each topic."""

    files: list[str]
    topics: dict[str, tuple[str, int]]
    custom: dict[str, str]
    distribution: str


class Contents(NamedTuple):
    """Topics and times of a bag, the custom data of its metadata, and its ROS distribution.

    Attributes:
        connections: by topic, of all files.
        distribution: as ``humble``; empty if unknown.
        notes: sentences about what is odd, and is no damage.
    """

    connections: Mapping[str, Connection]
    start_ns: int
    duration_ns: int
    custom: dict[str, str]
    distribution: str
    notes: list[str]


class StoredBag:
    """A bag on the disk.

    A file that is compressed as a whole is decompressed once, into a temporary folder, which goes
    with this object.

    Args:
        path: a folder or file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._temporary: str | None = None
        self._storages: list[Storage] | None = None

    def contents(self) -> Contents:
        """Read metadata and index; of a bag that was cut off, all of its files.

        Raises:
            EnvironmentFault: if it cannot be read.
            UsageError: if it is no bag.
        """
        with damage_of(self.path):
            metadata = self._metadata()
            is_complete = metadata is not None  # which is written last
            for path in self._paths(metadata) if metadata is None else ():
                with open_ordinary(path) as file:
                    begins = file.read(len(SQLITE_MAGIC))
                known = (SQLITE_MAGIC, ROS_1_MAGIC, _ZSTD_MAGIC, MCAP0_MAGIC)
                # One that was cut off may be shorter.
                if not any(begins[: len(magic)] == magic[: len(begins)] for magic in known):
                    text = f"{path} is no bag: it begins neither as MCAP nor as SQLite"
                    raise UsageError(text)
            parts = [s.contents(is_complete=is_complete) for s in self._files(metadata)]
            found: dict[str, Connection] = {}
            for each in (c for part in parts for c in part.connections):
                before = found.get(each.topic, each._replace(msgcount=0))
                if before.msgtype != each.msgtype:
                    raise ReaderError(
                        f"{each.topic} is of type {before.msgtype}, and {each.msgtype}"
                    )
                found[each.topic] = before._replace(msgcount=before.msgcount + each.msgcount)
            notes = [part.note for part in parts if part.note]
            if metadata is not None:
                found, differences = _agreed(metadata, found)
                notes += differences
            start_ns = min((part.start_ns for part in parts), default=LAST_NS)
            end_ns = max((part.end_ns for part in parts), default=0)
            told = [each.distribution for each in parts if each.distribution]
            return Contents(
                found,
                start_ns,
                max(0, end_ns - start_ns),
                metadata.custom if metadata else {},
                (metadata.distribution if metadata else "") or (told[0] if told else ""),
                notes,
            )

    def messages(
        self, complain: Callable[[str], object] = lambda _: None, only: str | None = None
    ) -> Iterator[Stored]:
        """All messages that can be read.

        Args:
            complain: receives a sentence for each damaged part of a file.
            only: the topic to read; all if ``None``.
        """
        metadata = None
        with suppress(EnvironmentFault), damage_of(self.path):
            metadata = self._metadata()
        try:
            with damage_of(self.path):
                files = self._files(metadata)
        except EnvironmentFault as error:
            complain(str(error))
            return
        for file in files:
            for stored in file.messages(complain, only):
                if stored.data[:4] == _ZSTD_MAGIC:  # with which no CDR begins
                    try:
                        stored = stored._replace(data=zstd.decompress(stored.data))
                    except zstd.ZstdError:
                        complain(f"{self.path}: a message of {stored.topic} is damaged")
                        continue
                yield stored

    def _metadata(self) -> _Metadata | None:
        """Raises any exception if it is damaged."""
        path = self.path / METADATA_NAME
        if self.path.is_file() or not path.exists():
            return None
        try:
            found = YAML(typ="safe", pure=False).load(read_bytes(path).decode())
        except YAMLError as error:
            raise ReaderError(f"{METADATA_NAME} is no YAML: {error}") from None
        information = found["rosbag2_bagfile_information"]
        topics = {}
        for topic in information["topics_with_message_count"]:
            about, count = topic["topic_metadata"], topic["message_count"]
            if type(count) is not int or count < 0:
                raise ReaderError(f"{about['name']} has {count} packets")
            topics[about["name"]] = (about["type"], count)
        return _Metadata(
            [PurePath(name).name for name in information["relative_file_paths"]],
            topics,
            dict(information.get("custom_data") or {}),
            str(information.get("ros_distro") or "")
            or _DISTRIBUTIONS.get(information["version"], ""),
        )

    def _files(self, metadata: _Metadata | None) -> list[Storage]:
        """Readers of the files, in their order. Raises ``OSError``, ``ReaderError``."""
        if self._storages is None:
            self._storages = [storage_of(self._plain(path)) for path in self._paths(metadata)]
        return self._storages

    def _paths(self, metadata: _Metadata | None) -> list[Path]:
        if self.path.is_file():
            return [self.path]
        if metadata is None:
            return bag_files(self.path)
        paths = [self.path / name for name in metadata.files]
        if missing := [path.name for path in paths if not path.exists()]:
            raise ReaderError(f"{METADATA_NAME} names {missing[0]}, which is not there")
        return paths

    def _plain(self, path: Path) -> Path:
        """The file, or in its place a decompressed and completed copy."""
        with open_ordinary(path) as file:
            begins = file.read(len(SQLITE_MAGIC))
            is_compressed = begins.startswith(_ZSTD_MAGIC)
            beside = [path.with_name(f"{path.name}{suffix}") for suffix in ("-wal", "-journal")]
            logs = [each for each in beside if each.is_file() and each.stat().st_size]
            if not is_compressed and not (logs and begins == SQLITE_MAGIC):
                return path
            if self._temporary is None:
                self._temporary = mkdtemp(prefix="neuros-bag-")
                weakref.finalize(self, shutil.rmtree, self._temporary, ignore_errors=True)
            copy = Path(self._temporary, path.name)
            file.seek(0)
            with copy.open("xb") as plain:
                shutil.copyfileobj(zstd.open(file) if is_compressed else file, plain)
        for log in logs:
            shutil.copyfile(log, copy.with_name(log.name))
        if logs:
            checkpointed(copy)
        return copy


def bag_files(folder: Path) -> list[Path]:
    found = (each for each in folder.iterdir() if each.name.endswith(_SUFFIXES))
    return sorted(found, key=lambda each: (len(each.name), each.name))  # bag_2 before bag_10


def faults_of(bag: StoredBag, counts: Mapping[str, int]) -> list[str]:
    """A sentence for each damage of a bag; reads all of it.

    Args:
        counts: by topic, how many messages the bag should have.
    """
    faults: list[str] = []
    found = Counter(message.topic for message in bag.messages(faults.append))
    return faults or [
        are_left(bag.path, name, count, found[name])
        for name, count in counts.items()
        if found[name] < count
    ]


def is_whole(folder: Path) -> bool:
    """Whether metadata, types, beginning and end of the files of a bag can be read."""
    try:
        contents = StoredBag(folder).contents()
        with damage_of(folder):
            for recorded in contents.connections.values():
                TopicType(recorded, contents.distribution, ())
    except (EnvironmentFault, UsageError):
        return False
    return (folder / METADATA_NAME).exists()


def are_left(folder: Path, topic: str, count: int, left: int) -> str:
    """A sentence on missing messages."""
    return f"{folder}: of {count} packets of {topic} {left} are left"


@contextmanager
def damage_of(folder: Path, what: str = "") -> Iterator[None]:
    """Turn any exception of ``rosbags``, and of other readers, into ``EnvironmentFault``.

    Args:
        what: the part of the bag that is read; empty: all of it.
    """
    try:
        yield
    except (EnvironmentFault, UsageError):
        raise
    except Exception as error:
        why = shorten(str(error), 200, placeholder=" ...") or type(error).__name__
        place = f"{folder}: {what}" if what else str(folder)
        raise EnvironmentFault(f"{place} cannot be read: it is damaged ({why})") from error


def _agreed(
    metadata: _Metadata, found: Mapping[str, Connection]
) -> tuple[dict[str, Connection], list[str]]:
    """Topics in the order of the metadata, and sentences on those with fewer messages than it says.

    Raises:
        ReaderError: where metadata and files do not have the same topics.
    """
    for name, each in found.items():
        if each.msgcount and name not in metadata.topics:
            raise ReaderError(
                f"{METADATA_NAME} does not name the topic {name}, which its files have"
            )
    agreed, notes = {}, []
    for name, (kind, count) in metadata.topics.items():
        there = found.get(name)
        if there is None or there.msgtype != kind:
            if count:
                raise ReaderError(f"its files do not have the topic {name} of type {kind}")
            there = connection(0, name, kind, "cdr")
        if there.msgcount < count and "run_id" in metadata.custom:
            there = there._replace(msgcount=count)  # as many were written, so the others are lost
        elif there.msgcount < count:
            notes.append(
                f"{METADATA_NAME} counts {count} packets of {name}, and the files have"
                f" {there.msgcount}"
            )
        agreed[name] = there
    return agreed, notes
