"""Recorded packets of a run, as NumPy arrays; with ``neuros[analysis]``, as frames and datasets.

::

    import neuros.bag

    with neuros.bag.open("runs/whiskeye/2026-11-21T15-00-00.000000Z") as bag:
        imu = bag["robot.imu"].array()            # structured array, one row per packet
        speed = imu["linear_acceleration.x"]
        frame = bag["/clock"].frame()             # pandas
        images = bag["robot.camera"].xarray()     # xarray
"""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import datetime, timezone
from functools import cached_property
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Connection, QosDurability, QosReliability
from rosbags.typesys import Stores, get_typestore

from neuros.errors import EnvironmentFault, UsageError
from neuros.project.timing import VIRTUAL
from neuros.recording.bag_writer import BagWriter, define
from neuros.recording.columns import LOG_TIME, PUBLISH_TIME, Column, columns_of
from neuros.recording.recorder import lost_of, named, needs_repair, recorded_counts, repair
from neuros.recording.recording_plan import BAG_NAME, PLAN_NAME, Topic, is_named, load_plan
from neuros.recording.stored import (
    METADATA_NAME,
    StoredBag,
    are_left,
    bag_files,
    damage_of,
    faults_of,
)
from neuros.recording.topic_types import TopicType
from neuros.registry import BAG_FORMATS

_FEW_PACKETS = 5
"""Of a topic, to find the definition of its type that fits."""

__all__ = ["Bag", "RawPacket", "RecordedTopic", "open"]


class RawPacket(NamedTuple):
    """A recorded packet: wall time and simulated time in nanoseconds, and bytes of CDR."""

    log_time_ns: int
    publish_time_ns: int
    data: bytes


class RecordedTopic:
    """The packets of one topic, in the order in which they were sent.

    Attributes:
        name: the topic.
        type: its message type in ROS notation.
        connection: ``a.out -> b.in``, or ``None`` for a topic that belongs to none.
        is_reliable, depth, is_latched: of the offered quality of service.
        count: how many packets the topic has.
    """

    def __init__(self, bag: Bag, recorded: Connection, connection: str | None) -> None:
        self._bag = bag
        self._recorded = recorded
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

    @property
    def is_virtual(self) -> bool:
        """Whether it is of a run in virtual time, whose packets have no wall time."""
        return self._bag.custom.get("time") == VIRTUAL

    def raw(self) -> list[RawPacket]:
        """All packets, in the order of their wall time."""
        return self._bag.packets_of(self.name)

    @cached_property
    def definition(self) -> TopicType:
        """How its packets are decoded.

        Raises:
            EnvironmentFault: if neither the bag nor this machine defines its type.
        """
        some = self._bag.first_packets(self.name, _FEW_PACKETS)
        with damage_of(self._bag.folder, self.name):
            try:
                return TopicType(self._recorded, self._bag.distribution, some)
            except EnvironmentFault as fault:
                place = f"{self._bag.folder}: {self.name}"
                raise EnvironmentFault(f"{place} cannot be decoded: {fault}") from fault

    @property
    def misfit(self) -> str:
        """Why programs of this machine cannot read its packets, in a sentence; empty if they can.

        Raises:
            EnvironmentFault: if its type is not known at all.
        """
        how, here = self.definition, get_typestore(Stores.EMPTY)
        try:
            define(how.name, here)
        except EnvironmentFault as fault:
            return str(fault)
        is_same = here.hash_rihs01(how.name) == how.store.hash_rihs01(how.name)
        return "" if is_same else f"{how.name} has other fields in the bag than it has here"

    def decode(self, data: bytes) -> Any:
        """A message from a packet. Raises ``EnvironmentFault`` for other bytes."""
        how = self.definition
        with damage_of(self._bag.folder, f"a packet of type {self.type}"):
            return how.store.deserialize_cdr(data, how.name)

    def messages(self) -> Iterator[tuple[RawPacket, Any]]:
        """Packets with their messages, which ``rosbags`` decodes one by one."""
        for packet in self.raw():
            yield packet, self.decode(packet.data)

    def __iter__(self) -> Iterator[Any]:
        """The messages, in the order of their wall time."""
        return (message for _, message in self.messages())

    def message(self, place: int) -> Any:
        """The message at a place, from 0. Raises ``IndexError``."""
        return self.decode(self.raw()[place].data)

    def columns(self) -> dict[str, Column]:
        """A column for each field, and the two times; see :meth:`array`."""
        packets, how = self.raw(), self.definition
        with damage_of(self._bag.folder, self.name):
            return {
                LOG_TIME: np.array([p.log_time_ns for p in packets], np.int64),
                PUBLISH_TIME: np.array([p.publish_time_ns for p in packets], np.int64),
                **columns_of([p.data for p in packets], how.name, how.store),
            }

    def array(self) -> npt.NDArray[Any]:
        """A structured array, one row per packet.

        Its fields are ``log_time_ns`` (wall time, or virtual time), ``publish_time_ns`` (simulated
        time, where there is one) and those of the message, with dots: ``header.stamp.sec``. Arrays
        keep their shape; sequences of different length are objects.
        """
        columns = self.columns()
        rows = len(columns[LOG_TIME])
        made = np.empty(rows, [(name, c.dtype, c.shape[1:]) for name, c in columns.items()])
        for name, column in columns.items():
            made[name] = column
        return made

    def frame(self, clock: Literal["wall", "sim"] = "wall") -> Any:
        """A ``pandas.DataFrame``, one row per packet; arrays get a column for each element.

        Args:
            clock: of the index ``time``: ``wall``, when packets were sent (UTC; of a run in virtual
                time, a ``TimedeltaIndex`` of that), or ``sim``, the simulated time (a
                ``TimedeltaIndex``).

        Raises:
            UsageError: for the simulated time of a bag that has none, and without the extension
                that makes frames.
        """
        return BAG_FORMATS.load("frame")(self, clock)

    def xarray(self) -> Any:
        """An ``xarray.Dataset``: a variable for each field, along the dimension ``time``.

        Images of one size are ``(time, y, x, channel)``, those of one channel ``(time, y, x)``; the
        axes of other arrays have names like ``position_0``. The coordinate ``time`` is simulated
        time in seconds; where there is none, wall time since the first packet of the bag. The
        coordinate ``wall_time`` is that of the wall clock (UTC); a run in virtual time has
        ``virtual_time`` in its place. Variables whose unit the ROS
        definition states have it as the attribute ``units``.

        Raises:
            UsageError: without the extension that makes datasets.
        """
        known, name = self.definition.store.fielddefs, self.definition.name
        types = {**known, self.type: known[name]}
        return BAG_FORMATS.load("xarray")(self, types, self._bag.start_ns)

    def neo(self) -> Any:
        """A ``neo.Segment`` of recorded spikes (``neuros_msgs/msg/Spikes``).

        It has a ``SpikeTrain`` for each neuron of the population, in the order of their numbers,
        annotated with ``neuron``, in seconds of simulated time.

        Raises:
            EnvironmentFault: if Neo is not installed.
            UsageError: for packets of another type, and for spikes of neurons that are not there,
                and without the extension that makes segments.
        """
        return BAG_FORMATS.load("neo")(self)

    def nwb(self, file: str | os.PathLike[str]) -> None:
        """Write recorded spikes into a new file of Neurodata Without Borders, a unit per neuron.

        Raises:
            EnvironmentFault: if PyNWB is not installed.
            UsageError: as :meth:`neo`.
            OSError: if the file cannot be written.
        """
        custom, began_s = self._bag.custom, self._bag.start_ns / 1e9
        began = datetime.fromtimestamp(began_s, timezone.utc)
        if self.is_virtual:
            began = datetime.strptime(custom["started"], "%Y-%m-%dT%H:%M:%S%z")
        BAG_FORMATS.load("nwb")(self, file, custom.get("run_id", "unknown"), began)


class Bag:
    """Topics and metadata of a recorded run.

    Attributes:
        folder: the rosbag2 folder.
        topics: by name, in the order of the project.
        custom: metadata of the run: ``run_id``, ``project``, ``project_sha256``, ``versions``,
            ``seeds``.
        start_ns: wall time of the first packet, in nanoseconds since 1970; virtual time if the
            run was in virtual time.
        duration_s: from the first packet to the last.
        missing: by topic, how many packets the bag has lost since the run ended.
        distribution: of ROS, as ``humble``, where the bag tells; empty where not.
        notes: sentences about what is odd in the bag of another program, and no damage.
    """

    def __init__(
        self,
        folder: Path,
        connections: Mapping[str, str | None],
        recorded: Mapping[str, int] | None = None,
    ) -> None:
        self.folder = folder
        self._stored = StoredBag(folder)
        contents = self._stored.contents()
        self.custom, self.distribution = contents.custom, contents.distribution
        self.start_ns, self.duration_s = contents.start_ns, contents.duration_ns / 1e9
        self.notes = contents.notes
        self.topics = {
            name: RecordedTopic(self, each, connections.get(name))
            for name, each in contents.connections.items()
        }
        self.missing = lost_of(recorded or {}, {name: t.count for name, t in self.topics.items()})
        self._packets: dict[str, list[RawPacket]] = {}

    @property
    def damage(self) -> str | None:
        """The missing packets, in a sentence."""
        if not self.missing:
            return None
        missing = named(self.missing)
        return f"{self.folder} has been damaged since the run; packets that are missing: {missing}"

    def check(self) -> str | None:
        """Read all of the bag; returns its damage in a sentence, ``None`` if there is none."""
        faults = faults_of(self._stored, {name: topic.count for name, topic in self.topics.items()})
        return "; ".join([*([self.damage] if self.damage else []), *faults]) or None

    def expect(self, name: str, left: int) -> None:
        """Raise ``EnvironmentFault`` if a topic has fewer packets than the metadata counts."""
        if left < (count := self.topics[name].count):
            self.refuse(are_left(self.folder, name, count, left))

    def refuse(self, fault: str) -> None:
        """Raise ``EnvironmentFault`` for damage that was found while packets were read."""
        raise EnvironmentFault(
            f"{fault}: its content has changed since it was recorded (`neuros bag repair` keeps"
            " the packets that can be read)"
        )

    @property
    def project(self) -> str | None:
        """The name of the project."""
        return self.custom.get("project")

    def __getitem__(self, name: str) -> RecordedTopic:
        """The topic of that name, of that connection, or of that output.

        An output sends the same packets to all its receivers; of its connections, the one with most
        packets is returned, since they may differ in a run that was cut off.

        Raises:
            KeyError: if there is none; the text names all topics.
        """
        if name in self.topics:
            return self.topics[name]
        labels = {topic: topic.connection or "" for topic in self.topics.values()}
        fitting = [t for t, label in labels.items() if name in (label, label.partition(" -> ")[0])]
        if fitting:
            return max(fitting, key=lambda topic: topic.count)
        there = [topic.connection or topic.name for topic in self.topics.values()]
        raise KeyError(f"{name}: there are {', '.join(there)}")

    def message(self, data: bytes, type_name: str) -> Any:
        """A message of a type that the bag has. Raises ``EnvironmentFault`` for other bytes."""
        return next(t for t in self.topics.values() if t.type == type_name).decode(data)

    def chosen(self, patterns: Sequence[str]) -> list[RecordedTopic]:
        """Topics by their names, outputs or connections; ``*`` stands for any characters.

        Raises:
            UsageError: for a pattern that fits none.
        """
        topics = [*self.topics.values()]
        for pattern in patterns:
            if not any(is_named(t.name, t.connection, [pattern]) for t in topics):
                there = ", ".join(t.connection or t.name for t in topics)
                raise UsageError(f"--topic {pattern}: the bag has no such topic; it has {there}")
        return [t for t in topics if is_named(t.name, t.connection, patterns)]

    def first_packets(self, name: str, count: int) -> list[bytes]:
        """The first packets of a topic that can be read, in the order of the file."""
        return [each.data for each in islice(self._stored.messages(only=name), count)]

    def undecodable(self) -> dict[str, str]:
        """By topic that cannot be decoded, the reason, in a sentence."""
        found = {}
        for name, topic in self.topics.items():
            try:
                _ = topic.definition
            except EnvironmentFault as fault:
                found[name] = str(fault)
        return found

    def convert(self, folder: Path, topics: Collection[str]) -> int:
        """Write topics into a new rosbag2 folder, an MCAP file with all definitions; returns how
        many packets it has.

        Raises:
            EnvironmentFault: for a damaged bag, and a topic that cannot be decoded.
            OSError: if it cannot be written.
        """
        writer = BagWriter(folder, self.custom)
        try:
            numbers = {}
            for name in topics:
                each, how = self.topics[name], self.topics[name].definition
                kind = each.type if "/srv/" in each.type else how.name
                kept = Topic(name, kind, each.is_reliable, each.depth, None, each.is_latched)
                numbers[name] = writer.add_topic(kept, how.store)
            for topic, log_ns, publish_ns, data, _ in self._stored.messages(self.refuse):
                if topic in numbers:
                    writer.put(numbers[topic], log_ns, publish_ns, data)
            writer.close()
        except BaseException:
            writer.shut()
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return sum(writer.counts.values())

    def packets_of(self, name: str) -> list[RawPacket]:
        """All packets of a topic, by their wall time."""
        if name not in self._packets:
            packets = [
                RawPacket(log_ns, publish_ns, data)
                for _, log_ns, publish_ns, data, _ in self._stored.messages(self.refuse, name)
            ]
            self.expect(name, len(packets))
            packets.sort(key=itemgetter(0))
            self._packets[name] = packets
        return self._packets[name]

    def close(self) -> None:
        """Release the packets that have been read."""
        self._packets.clear()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open(run: str | os.PathLike[str]) -> Bag:
    """Open the bag of a run; one that was cut off is completed first.

    Warns if packets have been lost since the run ended.

    Args:
        run: the run folder, a rosbag2 folder, or one file of a bag.

    Raises:
        UsageError: if there is no bag, or this version of NeuROS cannot read it.
        EnvironmentFault: if it is damaged.
    """
    bag = open_bag(run)
    if bag.damage is not None:
        warnings.warn(bag.damage, stacklevel=2)
    return bag


def open_bag(run: str | os.PathLike[str]) -> Bag:
    """Open the bag of a run, as :func:`open`, but without a warning."""
    folder = Path(run)
    has_files = folder.is_dir() and bool(bag_files(folder))
    if not (folder / PLAN_NAME).is_file():
        if folder.name == BAG_NAME and (folder.parent / PLAN_NAME).is_file():
            folder = folder.parent
        elif folder.is_file() or (folder / METADATA_NAME).is_file() or has_files:
            return Bag(folder, {})
    plan, recorded = load_plan(folder), recorded_counts(folder)
    if needs_repair(folder, plan):
        try:
            repair(folder, lambda _: None)
        except EnvironmentFault:  # the run still goes on, or there is no room
            if not (folder / BAG_NAME).is_dir():
                raise
    connections = {topic.name: topic.connection for topic in plan.topics}
    bag = Bag(folder / BAG_NAME, connections, recorded)
    bag.custom = bag.custom or dict(plan.custom)  # metadata are written at the end
    return bag
