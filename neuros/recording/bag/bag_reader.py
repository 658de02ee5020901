"""Bag that is open for reading."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Connection, QosDurability, QosReliability
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from neuros.errors import EnvironmentFault, UsageError
from neuros.recording.bag.columns import Column, columns_of
from neuros.recording.plan import BAG_NAME, PLAN_NAME, load_plan
from neuros.recording.repair import needs_repair, repair
from neuros.recording.run_file import read_run_file
from neuros.recording.stored import StoredTopics

LOG_TIME, PUBLISH_TIME = "log_time_ns", "publish_time_ns"
_MOST_COLUMNS = 100


class RawPacket(NamedTuple):
    """A packet as it was recorded: wall time and simulated time in nanoseconds, and CDR."""

    log_time_ns: int
    publish_time_ns: int
    data: bytes


class RecordedTopic:
    """The packets of one topic, in the order in which they were sent.

    Attributes:
        name: the topic.
        type: its message type in ROS notation.
        connection: ``a.out -> b.in``, or ``None`` for a topic that belongs to none.
        is_reliable, depth, is_latched: of the quality of service that was offered.
        count: how many packets there are.
    """

    def __init__(self, bag: Bag, recorded: Connection, connection: str | None) -> None:
        self._bag = bag
        self.name = recorded.topic
        self.type = recorded.msgtype
        self.connection = connection
        self.count = recorded.msgcount
        profiles = getattr(recorded.ext, "offered_qos_profiles", None) or []
        self.is_reliable = all(p.reliability is QosReliability.RELIABLE for p in profiles)
        self.is_latched = bool(profiles) and all(
            p.durability is QosDurability.TRANSIENT_LOCAL for p in profiles
        )
        self.depth = max((p.depth for p in profiles), default=0) or 10

    def raw(self) -> list[RawPacket]:
        """All packets as they were recorded."""
        return self._bag.packets_of(self.name)

    def messages(self) -> Iterator[tuple[RawPacket, Any]]:
        """Packets and messages, made by ``rosbags`` one by one."""
        for packet in self.raw():
            yield packet, self._bag.store.deserialize_cdr(packet.data, self.type)

    def message(self, place: int) -> Any:
        """The message at a place, from 0. Raises ``IndexError``."""
        return self._bag.store.deserialize_cdr(self.raw()[place].data, self.type)

    def columns(self) -> dict[str, Column]:
        """A column for each field, and the two times; see :meth:`array`."""
        packets = self.raw()
        return {
            LOG_TIME: np.fromiter((p.log_time_ns for p in packets), np.int64, len(packets)),
            PUBLISH_TIME: np.fromiter((p.publish_time_ns for p in packets), np.int64, len(packets)),
            **columns_of([p.data for p in packets], self.type, self._bag.store),
        }

    def array(self) -> npt.NDArray[Any]:
        """A structured array, one row per packet.

        Its fields are ``log_time_ns`` (wall time), ``publish_time_ns`` (simulated time, where there
        is one) and those of the message, with dots: ``header.stamp.sec``. Arrays keep their shape;
        sequences of different length are objects.
        """
        columns = self.columns()
        rows = len(columns[LOG_TIME])
        made = np.empty(rows, [(name, c.dtype, c.shape[1:]) for name, c in columns.items()])
        for name, column in columns.items():
            made[name] = column
        return made

    def frame(self) -> Any:
        """A ``pandas.DataFrame``, one row per packet; arrays get a column for each element.

        Its index ``time`` is the wall time (UTC) at which packets were sent.

        Raises:
            EnvironmentFault: if pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise EnvironmentFault(
                f"pandas is not installed for {sys.executable}: pip install pandas, or use array()"
            ) from error
        spread: dict[str, Any] = {}
        columns = self.columns()
        for name, column in columns.items():
            elements = math.prod(column.shape[1:])
            if column.ndim == 1:
                spread[name] = column
            elif elements <= _MOST_COLUMNS:
                for place, single in enumerate(column.reshape(len(column), elements).T):
                    spread[f"{name}[{place}]"] = single
            else:
                spread[name] = list(column)
        time = pd.to_datetime(columns[LOG_TIME], unit="ns", utc=True)
        return pd.DataFrame(spread, index=time.rename("time"))


class Bag:
    """Topics and metadata of a recorded run.

    Attributes:
        folder: the rosbag2 folder.
        topics: by name, in the order of the project.
        custom: what its metadata says of the run: ``run_id``, ``project``, ``project_sha256``,
            ``versions``, ``seeds``.
        duration_s: from the first packet to the last.
        missing: by topic, how many packets were in the bag when the run ended, and are not now.
    """

    def __init__(
        self,
        folder: Path,
        connections: Mapping[str, str | None],
        recorded: Mapping[str, int] | None = None,
    ) -> None:
        self.folder = folder
        try:
            with Reader(folder) as reader:
                self.custom: dict[str, str] = dict(reader.storage.metadata.custom or {})
                self.duration_s = reader.duration / 1e9
                found = {c.topic: c for c in reader.connections}
        except ReaderError as error:
            why = " ".join(str(error).split())
            raise EnvironmentFault(f"{folder} cannot be read: it is damaged ({why})") from error
        self.store = _store_of(found.values())
        self.topics = {
            name: RecordedTopic(self, c, connections.get(name)) for name, c in found.items()
        }
        self.missing = {
            name: lost
            for name, count in (recorded or {}).items()
            if (lost := count - (self.topics[name].count if name in self.topics else 0)) > 0
        }
        self._stored = StoredTopics(folder)
        self._packets: dict[str, list[RawPacket]] = {}

    @property
    def damage(self) -> str | None:
        """The missing packets, in a sentence."""
        if not self.missing:
            return None
        topics = ", ".join(f"{lost} of {name}" for name, lost in self.missing.items())
        return f"{self.folder} has been damaged since the run; packets that are missing: {topics}"

    @property
    def project(self) -> str | None:
        """The name of the project."""
        return self.custom.get("project")

    def __getitem__(self, name: str) -> RecordedTopic:
        """The topic of that name, of that connection, or of that output.

        An output sends the same packets to all its receivers; of a run that was cut off, the
        connection that came furthest is taken.

        Raises:
            KeyError: if there is none; its text names those that there are.
        """
        if name in self.topics:
            return self.topics[name]
        labels = {topic: topic.connection or "" for topic in self.topics.values()}
        fitting = [t for t, label in labels.items() if name in (label, label.partition(" -> ")[0])]
        if fitting:
            return max(fitting, key=lambda topic: topic.count)
        there = [topic.connection or topic.name for topic in self.topics.values()]
        raise KeyError(f"{name}: there are {', '.join(there)}")

    def packets_of(self, name: str) -> list[RawPacket]:
        """All packets of a topic, by their wall time."""
        if name not in self._packets:
            packets = [
                RawPacket(log_ns, publish_ns, data)
                for _, log_ns, publish_ns, data in self._stored.messages(name)
            ]
            packets.sort(key=itemgetter(0))
            self._packets[name] = packets
        return self._packets[name]

    def close(self) -> None:
        """Let go of what has been read."""
        self._packets.clear()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_bag(run: str | os.PathLike[str]) -> Bag:
    """Open what a run has recorded; one that was cut off is completed first.

    Args:
        run: the run folder, or a rosbag2 folder.

    Raises:
        UsageError: if there is none, or this version of NeuROS cannot read it.
        EnvironmentFault: if it is damaged.
    """
    folder = Path(run)
    if (folder / "metadata.yaml").is_file() and not (folder / PLAN_NAME).is_file():
        if not (folder.parent / PLAN_NAME).is_file():
            return Bag(folder, {})
        folder = folder.parent
    plan = load_plan(folder)
    if needs_repair(folder, plan):
        _repair_if_possible(folder)
    connections = {topic.name: topic.connection for topic in plan.topics}
    return Bag(folder / BAG_NAME, connections, _recorded(folder))


def _recorded(run: Path) -> dict[str, int]:
    """By topic, the packets that were in the bag when the run ended, as far as is known."""
    try:
        topics = read_run_file(run)["recording"]["topics"]
        return {name: int(topic["recorded"]) for name, topic in topics.items()}
    except (UsageError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _repair_if_possible(run: Path) -> None:
    """A run that still goes on has a bag that can be read as it is."""
    try:
        repair(run, lambda _: None)
    except EnvironmentFault:
        if not (run / BAG_NAME / "metadata.yaml").is_file():
            raise


def _store_of(connections: Any) -> Typestore:
    """The types as the bag defines them."""
    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    connection: Connection
    for connection in connections:
        types |= get_types_from_msg(connection.msgdef.data, connection.msgtype)
    store.register(types)
    return store
