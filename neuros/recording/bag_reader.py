"""Bag that is open for reading, and its messages as columns.

NumPy takes columns from the bytes of messages. In messages of fixed size, a number is always at the
same place; in those with strings and sequences, it depends on their lengths, and most topics repeat
a few lengths for ever, as of a ``frame_id``. So a layout is worked out from one message, and serves
all that have the same lengths (plain CDR: OMG DDSI-RTPS 2.5, 10.2).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Connection, QosDurability, QosReliability
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from neuros.errors import EnvironmentFault
from neuros.recording.labelled import (
    LOG_TIME,
    PUBLISH_TIME,
    Column,
    dataset_of,
    library,
    segment_of,
    simulated_time_ns,
    write_nwb,
)
from neuros.recording.recorder import needs_repair, recorded_counts, repair
from neuros.recording.recording_plan import BAG_NAME, PLAN_NAME, load_plan
from neuros.recording.stored import StoredTopics, damage_of, opened, stored_messages

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
            yield packet, self._bag.message(packet.data, self.type)

    def message(self, place: int) -> Any:
        """The message at a place, from 0. Raises ``IndexError``."""
        return self._bag.message(self.raw()[place].data, self.type)

    def columns(self) -> dict[str, Column]:
        """A column for each field, and the two times; see :meth:`array`."""
        packets = self.raw()
        with damage_of(self._bag.folder):
            return {
                LOG_TIME: np.array([p.log_time_ns for p in packets], np.int64),
                PUBLISH_TIME: np.array([p.publish_time_ns for p in packets], np.int64),
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

    def frame(self, clock: Literal["wall", "sim"] = "wall") -> Any:
        """A ``pandas.DataFrame``, one row per packet; arrays get a column for each element.

        Args:
            clock: of the index ``time``: ``wall``, when packets were sent (UTC), or ``sim``, the
                simulated time (a ``TimedeltaIndex``).

        Raises:
            EnvironmentFault: if pandas is not installed.
            UsageError: for the simulated time of a bag that has none.
        """
        pd = library("pandas", "array()")
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
        if clock == "sim":
            time = pd.to_timedelta(simulated_time_ns(self, columns), unit="ns")
        else:
            time = pd.to_datetime(columns[LOG_TIME], unit="ns", utc=True)
        return pd.DataFrame(spread, index=time.rename("time"))

    def xarray(self) -> Any:
        """An ``xarray.Dataset``: a variable for each field, along the dimension ``time``.

        Images of one size are ``(time, y, x, channel)``, those of one channel ``(time, y, x)``; the
        axes of other arrays have names like ``position_0``. The coordinate ``time`` is simulated
        time in seconds; where there is none, wall time since the first packet of the bag. The
        coordinate ``wall_time`` is that of the wall clock (UTC). Variables whose unit the ROS
        definition states have it as the attribute ``units``.

        Raises:
            EnvironmentFault: if xarray is not installed.
        """
        return dataset_of(self, self._bag.store.fielddefs, self._bag.start_ns)

    def neo(self) -> Any:
        """A ``neo.Segment`` of recorded spikes (``neuros_msgs/msg/Spikes``).

        It has a ``SpikeTrain`` for each neuron of the population, in the order of their numbers,
        annotated with ``neuron``, in seconds of simulated time.

        Raises:
            EnvironmentFault: if Neo is not installed.
            UsageError: for packets of another type, and for spikes of neurons that are not there.
        """
        return segment_of(self)

    def nwb(self, file: str | os.PathLike[str]) -> None:
        """Write recorded spikes into a new file of Neurodata Without Borders, a unit per neuron.

        Raises:
            EnvironmentFault: if PyNWB is not installed.
            UsageError: as :meth:`neo`.
            OSError: if the file cannot be written.
        """
        write_nwb(self, file, self._bag.start_ns, self._bag.custom.get("run_id", "unknown"))


class Bag:
    """Topics and metadata of a recorded run.

    Attributes:
        folder: the rosbag2 folder.
        topics: by name, in the order of the project.
        custom: what its metadata says of the run: ``run_id``, ``project``, ``project_sha256``,
            ``versions``, ``seeds``.
        start_ns: wall time of the first packet, in nanoseconds since 1970.
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
        with opened(folder) as reader, damage_of(folder):
            self.custom: dict[str, str] = dict(reader.storage.metadata.custom or {})
            self.start_ns, self.duration_s = reader.start_time, reader.duration / 1e9
            found = {c.topic: c for c in reader.connections}
            self.store = _store_of(found.values())
            self.topics = {
                name: RecordedTopic(self, c, connections.get(name)) for name, c in found.items()
            }
        self.missing = {
            name: lost
            for name, count in (recorded or {}).items()
            if (lost := count - (self.topics[name].count if name in self.topics else 0)) > 0
        }
        self._stored = StoredTopics(folder, self.refuse)
        self._packets: dict[str, list[RawPacket]] = {}

    @property
    def damage(self) -> str | None:
        """The missing packets, in a sentence."""
        if not self.missing:
            return None
        topics = ", ".join(f"{lost} of {name}" for name, lost in self.missing.items())
        return f"{self.folder} has been damaged since the run; packets that are missing: {topics}"

    def check(self) -> str | None:
        """What is wrong with the bag, in a sentence; reads all of it."""
        faults: list[str] = []
        for _ in stored_messages(self.folder, faults.append):
            pass
        return "; ".join([*([self.damage] if self.damage else []), *faults]) or None

    def refuse(self, fault: str) -> None:
        """Raise a fault of its files, which readers of packets cannot pass over."""
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

    def message(self, data: bytes, type_name: str) -> Any:
        """A message of a type that the bag has. Raises ``EnvironmentFault`` for other bytes."""
        with damage_of(self.folder):
            return self.store.deserialize_cdr(data, type_name)

    def packets_of(self, name: str) -> list[RawPacket]:
        """All packets of a topic, by their wall time."""
        if name not in self._packets:
            packets = [
                RawPacket(log_ns, publish_ns, data)
                for _, log_ns, publish_ns, data, _ in self._stored.messages(name)
            ]
            count = self.topics[name].count
            if len(packets) < count:
                self.refuse(f"{self.folder}: of {count} packets of {name} {len(packets)} are left")
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
    """Open the bag of a run, as :func:`neuros.bag.open`, but without a warning."""
    folder = Path(run)
    if (folder / "metadata.yaml").is_file() and not (folder / PLAN_NAME).is_file():
        if not (folder.parent / PLAN_NAME).is_file():
            return Bag(folder, {})
        folder = folder.parent
    plan = load_plan(folder)
    if needs_repair(folder, plan):
        _repair_if_possible(folder)
    connections = {topic.name: topic.connection for topic in plan.topics}
    return Bag(folder / BAG_NAME, connections, recorded_counts(folder))


def _repair_if_possible(run: Path) -> None:
    """A run that still goes on has a bag that can be read as it is."""
    try:
        repair(run, lambda _: None)
    except EnvironmentFault:
        if not (run / BAG_NAME / "metadata.yaml").is_file():
            raise


def _store_of(connections: Iterable[Connection]) -> Typestore:
    """The types as the bag defines them."""
    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    for connection in connections:
        types |= get_types_from_msg(connection.msgdef.data, connection.msgtype)
    store.register(types)
    return store


_CDR_HEADER = b"\0\1\0\0"  # plain CDR, little-endian
_NUMBERS = {
    "bool": "?", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "<i2",
    "uint16": "<u2", "int32": "<i4", "uint32": "<u4", "int64": "<i8", "uint64": "<u8",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip
_EMPTY = "structure_needs_at_least_one_member"
_BASE, _NAME, _ARRAY = 1, 2, 3
_MOST_LAYOUTS = 64


class _Irregular(Exception):
    """Data without a layout: sequences of messages or strings, wide strings, big-endian data."""


class _Layout:
    """The places in a message, counted from its beginning, and in all with the same lengths.

    Args:
        types: the field definitions of a ``rosbags`` type store.

    Attributes:
        numbers: name, NumPy type (with its shape) and place of each number or row of numbers.
        texts: name, place and length of each string.
        lengths: places of the lengths that all this depends on.

    Raises:
        _Irregular: if the message has none.
    """

    def __init__(self, data: bytes, type_name: str, types: Mapping[str, Any]) -> None:
        if data[: len(_CDR_HEADER)] != _CDR_HEADER:
            raise _Irregular
        self.numbers: list[tuple[str, np.dtype[Any], int]] = []
        self.texts: list[tuple[str, int, int]] = []
        self.lengths: list[int] = []
        self._data = data
        self._types = types
        self._at = len(_CDR_HEADER)
        self._message(type_name, "")

    def _message(self, type_name: str, prefix: str) -> None:
        for name, (kind, details) in self._types[type_name][1]:
            if name.startswith(_EMPTY):
                self._at += 1
            elif kind.value == _BASE:
                self._base(f"{prefix}{name}", details[0])
            elif kind.value == _NAME:
                self._message(details, f"{prefix}{name}.")
            elif kind.value == _ARRAY:
                self._row(f"{prefix}{name}", details[0], details[1], is_array=True)
            else:
                self._row(f"{prefix}{name}", details[0], self._length(), is_array=False)

    def _base(self, name: str, type_name: str) -> None:
        if type_name == "string":
            size = self._length()
            self.texts.append((name, self._at, max(0, size - 1)))
            self._at += size
        else:
            self._number(name, type_name, ())

    def _row(self, name: str, element: Any, count: int, *, is_array: bool) -> None:
        kind, details = element[0].value, element[1]
        if kind == _BASE and details[0] in _NUMBERS:
            self._number(name, details[0], (count,))
        elif count == 0:
            self._number(name, "uint8", (0,))
        elif kind == _NAME and is_array:
            for place in range(count):
                self._message(details, f"{name}[{place}].")
        else:
            raise _Irregular

    def _number(self, name: str, type_name: str, shape: tuple[int, ...]) -> None:
        if type_name not in _NUMBERS:
            raise _Irregular
        kind: np.dtype[Any] = np.dtype((np.dtype(_NUMBERS[type_name]), shape))
        if shape != (0,):
            self._align(kind.base.itemsize)
        self.numbers.append((name, kind, self._at))
        self._at += kind.itemsize

    def _length(self) -> int:
        self._align(4)
        self.lengths.append(self._at)
        self._at += 4
        return int.from_bytes(self._data[self._at - 4 : self._at], "little")

    def _align(self, size: int) -> None:
        self._at += -(self._at - len(_CDR_HEADER)) % size

    def fits(self, table: Column) -> npt.NDArray[np.bool_]:
        """Which rows of bytes, each a message, have the lengths of the first one."""
        fits = np.ones(len(table), np.bool_)
        for place in (0, *self.lengths):  # the header has four bytes, too
            part = slice(place, place + 4)
            fits &= (table[:, part] == table[0, part]).all(axis=1)
        return fits

    def columns(self, table: Column) -> dict[str, Column]:
        """A column for each number and string of contiguous rows of bytes."""
        columns: dict[str, Column] = {}
        count, size = table.shape
        for name, kind, place in self.numbers:
            if kind.itemsize:
                parts: Any = {"names": ["x"], "formats": [kind], "offsets": [place]}
                parts["itemsize"] = size
                columns[name] = table.view(np.dtype(parts))["x"][:, 0]
            else:
                columns[name] = np.zeros((count, 0), kind.base)
        for name, place, length in self.texts:
            if length:
                raw = np.ascontiguousarray(table[:, place : place + length]).view(f"S{length}")
                columns[name] = np.char.decode(raw[:, 0], "utf-8", "replace")
            else:
                columns[name] = np.zeros(count, "U1")
        return columns


def columns_of(packets: Sequence[bytes], type_name: str, store: Typestore) -> dict[str, Column]:
    """One column for each field, with one row for each message.

    Fields of messages within the message have names with dots, ``header.stamp.sec``. Arrays of
    numbers have a column with more than one dimension; so have sequences, where all are of the same
    length. Strings are ``str``. What is left (sequences of different length, or of messages) is in
    a column of objects.
    """
    if not packets:
        return _columns_of_none(type_name, store)
    found: dict[str, list[tuple[npt.NDArray[np.intp], Column]]] = {}
    for rows, columns in _parts(packets, type_name, store):
        for name, column in columns.items():
            found.setdefault(name, []).append((rows, column))
    return {name: _join(parts, len(packets)) for name, parts in found.items()}


def _columns_of_none(type_name: str, store: Typestore) -> dict[str, Column]:
    """The columns of no message: those of one whose strings and sequences are empty."""
    try:
        layout = _Layout(_CDR_HEADER, type_name, store.fielddefs)
    except _Irregular:
        return {name: np.empty(0, object) for name in _field_names(type_name, store.fielddefs)}
    numbers = {name: np.zeros((0, *kind.shape), kind.base) for name, kind, _ in layout.numbers}
    return numbers | {name: np.zeros(0, "U1") for name, _, _ in layout.texts}


def _field_names(type_name: str, types: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, (kind, details) in types[type_name][1]:
        if kind.value == _NAME:
            yield from _field_names(details, types, f"{prefix}{name}.")
        elif not name.startswith(_EMPTY):
            yield f"{prefix}{name}"


def _parts(
    packets: Sequence[bytes], type_name: str, store: Typestore
) -> Iterator[tuple[npt.NDArray[np.intp], dict[str, Column]]]:
    """Groups of messages with the same layout, and those without one in the end."""
    sizes = np.fromiter(map(len, packets), dtype=np.intp, count=len(packets))
    rest: list[npt.NDArray[np.intp]] = []
    layouts = 0
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        table = np.frombuffer(b"".join(packets[row] for row in rows.tolist()), np.uint8)
        table = table.reshape(len(rows), size)
        while len(rows):
            try:
                if layouts == _MOST_LAYOUTS:
                    raise _Irregular
                layout = _Layout(table[0].tobytes(), type_name, store.fielddefs)
            except (_Irregular, IndexError):
                rest.append(rows)
                break
            layouts += 1
            fits = layout.fits(table)
            yield rows[fits], layout.columns(np.ascontiguousarray(table[fits]))
            rows, table = rows[~fits], table[~fits]
    if rest:
        rows = np.concatenate(rest)
        columns: dict[str, list[Any]] = {}
        for row in rows.tolist():
            for name, value in _flat(store.deserialize_cdr(packets[row], type_name), ""):
                columns.setdefault(name, []).append(value)
        yield rows, {name: _objects_or_numbers(values) for name, values in columns.items()}


def _flat(message: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name in message.__dataclass_fields__:
        value = getattr(message, name)
        if hasattr(value, "__dataclass_fields__"):
            yield from _flat(value, f"{prefix}{name}.")
        elif name != "__msgtype__":
            yield f"{prefix}{name}", value


def _objects_or_numbers(values: Sequence[Any]) -> Column:
    if isinstance(values[0], (bool, int, float, str, np.generic)):
        return np.array(values)
    column = np.empty(len(values), object)
    for place, value in enumerate(values):
        column[place] = value
    return column


def _join(parts: Sequence[tuple[npt.NDArray[np.intp], Column]], count: int) -> Column:
    shapes = {column.shape[1:] for _, column in parts}
    if len(shapes) == 1 and all(column.dtype != object for _, column in parts):
        kind = np.result_type(*(column.dtype for _, column in parts))
        joined = np.empty((count, *shapes.pop()), kind)
        for rows, column in parts:
            joined[rows] = column
        return joined
    objects = np.empty(count, object)
    for rows, column in parts:
        for row, value in zip(rows, column, strict=True):
            objects[row] = value
    return objects
