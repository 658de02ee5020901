"""Recorded messages as columns of NumPy, and as the libraries of scientists have them.

NumPy takes columns from the bytes of messages. In messages of fixed size, a number is always at the
same place; in those with strings and sequences, it depends on their lengths, and most topics repeat
a few lengths for ever, as of a ``frame_id``. So a layout is worked out from one message, and serves
all that have the same lengths (plain CDR: OMG DDSI-RTPS 2.5, 10.2).

xarray, Neo and Neurodata Without Borders are given columns. Units are those that the definitions of
ROS messages state (REP 103); a field whose unit depends on something else, as the position of a
joint, has none. Neo and NWB count in seconds of simulated time. A span without spikes is part of
the recording, too: trains begin where the first packet's span does at the latest, and end with the
stamp of the last packet.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from rosbags.typesys.store import Typestore

from neuros.errors import EnvironmentFault, UsageError
from neuros.project.dashboard import SPIKES

Column: TypeAlias = npt.NDArray[Any]
"""Values of one field, a row per packet."""

LOG_TIME, PUBLISH_TIME = "log_time_ns", "publish_time_ns"
IMAGE = "sensor_msgs/msg/Image"
_CDR_HEADER = b"\0\1\0\0"  # plain CDR, little-endian
_NUMBERS = {
    "bool": "?", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "<i2",
    "uint16": "<u2", "int32": "<i4", "uint32": "<u4", "int64": "<i8", "uint64": "<u8",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip
_EMPTY = "structure_needs_at_least_one_member"
_BASE, _NAME, _ARRAY = 1, 2, 3
_MOST_LAYOUTS = 64
_UNITS = {
    "builtin_interfaces/msg/Duration": {"sec": "s", "nanosec": "ns"},
    "builtin_interfaces/msg/Time": {"sec": "s", "nanosec": "ns"},
    "geometry_msgs/msg/Accel": {"linear": "m/s^2", "angular": "rad/s^2"},
    "geometry_msgs/msg/Pose": {"position": "m"},
    "geometry_msgs/msg/Transform": {"translation": "m"},
    "geometry_msgs/msg/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/msg/Wrench": {"force": "N", "torque": "N m"},
    "sensor_msgs/msg/FluidPressure": {"fluid_pressure": "Pa", "variance": "Pa^2"},
    "sensor_msgs/msg/Illuminance": {"illuminance": "lx", "variance": "lx^2"},
    "sensor_msgs/msg/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2"},
    "sensor_msgs/msg/LaserScan": {
        **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), "rad"),
        **dict.fromkeys(("time_increment", "scan_time"), "s"),
        **dict.fromkeys(("range_min", "range_max", "ranges"), "m"),
    },
    "sensor_msgs/msg/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/msg/Range": {
        "field_of_view": "rad",
        **dict.fromkeys(("min_range", "max_range", "range"), "m"),
    },
    "sensor_msgs/msg/Temperature": {"temperature": "degC", "variance": "degC^2"},
}
# By encoding: the type of a pixel's values, and its channels.
_PIXELS = {
    **{name: ("u1", tuple(name[:-1])) for name in ("rgb8", "bgr8", "rgba8", "bgra8")},
    "rgb16": ("u2", tuple("rgb")),
    "bgr16": ("u2", tuple("bgr")),
    "mono8": ("u1", ()),
    "mono16": ("u2", ()),
    "8UC1": ("u1", ()),
    "8UC3": ("u1", (0, 1, 2)),
    "16UC1": ("u2", ()),
    "32FC1": ("f4", ()),
}
Floats = npt.NDArray[np.float64]


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
        return {name: np.empty(0, object) for name, _ in _fields(type_name, store.fielddefs)}
    numbers = {name: np.zeros((0, *kind.shape), kind.base) for name, kind, _ in layout.numbers}
    return numbers | {name: np.zeros(0, "U1") for name, _, _ in layout.texts}


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


class Topic(Protocol):
    """A recorded topic."""

    name: str
    type: str
    connection: str | None

    def columns(self) -> dict[str, Column]:
        """Its fields, by name, and the two times."""


def library(name: str, otherwise: str = "") -> Any:
    """An optional library.

    Args:
        otherwise: what works without it, for the error.

    Raises:
        EnvironmentFault: if it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        text = f"{name} is not installed for {sys.executable}: pip install {name}"
        raise EnvironmentFault(f"{text}, or use {otherwise}" if otherwise else text) from error


def has_simulated_time(columns: Mapping[str, Column]) -> bool:
    """Whether packets have another time than that of the wall clock."""
    return bool(np.any(columns[PUBLISH_TIME] != columns[LOG_TIME]))


def dataset_of(topic: Topic, types: Mapping[str, Any], start_ns: int) -> Any:
    """What :meth:`RecordedTopic.xarray` gives; ``start_ns``: wall time of the bag's first packet.

    Args:
        types: the field definitions of the bag's types.
    """
    xr = library("xarray", "array()")
    columns = topic.columns()
    is_simulated = has_simulated_time(columns)
    wall_ns, sim_ns = columns.pop(LOG_TIME), columns.pop(PUBLISH_TIME)
    if is_simulated:
        time_s, clock = sim_ns / 1e9, "simulated time"
    else:
        time_s, clock = (wall_ns - start_ns) / 1e9, "wall time since the first packet of the bag"
    found = dict(_fields(topic.type, types))
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {
        "time": ("time", time_s, {"units": "s", "long_name": clock}),
        "wall_time": ("time", wall_ns.astype("datetime64[ns]")),
    }
    images = [name for name, (of, _) in found.items() if of == IMAGE and name.endswith("data")]
    for name in images:
        prefix = name.removesuffix("data")
        if (pixels := pixels_of(columns, prefix)) is not None:
            dims = [f"{prefix}{dim}" for dim in ("y", "x", "channel")][: pixels.ndim - 1]
            variables[name] = (("time", *dims), pixels)
            if pixels.ndim == 4:
                channels = list(_PIXELS[str(columns[f"{prefix}encoding"][0])][1])
                coordinates[dims[2]] = (dims[2], channels)
            del columns[name]
    for name, column in columns.items():
        unit = found.get(name, ("", None))[1]
        dims = [f"{name}_{axis}" for axis in range(column.ndim - 1)]
        free = f"{name}_" if name in coordinates else name
        variables[free] = (("time", *dims), column, {"units": unit} if unit else {})
    label = {"connection": topic.connection} if topic.connection else {}
    return xr.Dataset(variables, coordinates, {"topic": topic.name, "type": topic.type, **label})


def _fields(
    type_name: str, types: Mapping[str, Any], prefix: str = "", unit: str | None = None
) -> Iterator[tuple[str, tuple[str, str | None]]]:
    """Of each field, with dots: the type that has it, and its unit where one is known."""
    units = _UNITS.get(type_name, {})
    for name, (_, details) in types[type_name][1]:
        its = units.get(name, unit)
        if isinstance(details, str) and details in types:
            yield from _fields(details, types, f"{prefix}{name}.", its)
        elif not name.startswith(_EMPTY):
            yield f"{prefix}{name}", (type_name, its)


def pixels_of(columns: Mapping[str, Column], prefix: str) -> Column | None:
    """Images ``(time, y, x[, channel])``; ``None`` unless all have one size and known pixels."""
    data = columns[f"{prefix}data"]
    about = [columns[f"{prefix}{name}"] for name in ("height", "width", "step", "is_bigendian")]
    encodings = columns[f"{prefix}encoding"]
    varies = any(len(np.unique(column)) != 1 for column in (encodings, *about))
    if data.ndim != 2 or varies or str(encodings[0]) not in _PIXELS:
        return None
    height, width, step, is_bigendian = (int(column[0]) for column in about)
    kind, channels = _PIXELS[str(encodings[0])]
    value = np.dtype(kind).newbyteorder(">" if is_bigendian else "<")
    used = width * max(1, len(channels)) * value.itemsize
    if step < used or data.shape[1] != height * step:
        return None
    rows = np.ascontiguousarray(data.reshape(len(data), height, step)[:, :, :used])
    pixels: Column = rows.view(value).astype(value.newbyteorder("="), copy=False)
    return pixels.reshape((len(data), height, width, *([len(channels)] if channels else [])))


@dataclass(frozen=True)
class SpikeTrains:
    """The spikes of a recorded population.

    Attributes:
        times_s: by neuron, the times of its spikes, rising.
        start_s, end_s: what was recorded.
    """

    times_s: list[Floats]
    start_s: float
    end_s: float


def trains_of(topic: Topic) -> SpikeTrains:
    """The spikes of a topic.

    Raises:
        UsageError: if its type is another one, it has no packet, the size of the population
            changes, or a packet has a neuron outside of it or not one time for each sender.
    """
    if topic.type != SPIKES:
        raise UsageError(f"{topic.name} has packets of {topic.type}: spike trains need {SPIKES}")
    columns = topic.columns()
    sizes = columns["size"]
    if not len(sizes):
        raise UsageError(f"{topic.name} has no packet, so the size of its population is unknown")
    size = int(sizes[0])
    senders, times = (_joined(columns[name]) for name in ("senders", "times"))
    if np.any(sizes != size):
        raise UsageError(f"{topic.name}: the population has {size} neurons, then {sizes.max()}")
    if len(senders) != len(times):
        raise UsageError(f"{topic.name}: {len(senders)} senders, but {len(times)} times")
    if np.any(senders >= size):
        raise UsageError(f"{topic.name}: a spike of neuron {senders.max():g} among {size}")
    stamps_s = columns["header.stamp.sec"] + columns["header.stamp.nanosec"] * 1e-9
    start_s = min(0.0, *times[:1], *stamps_s[:1])
    end_s = max(float(times.max(initial=start_s)), float(stamps_s.max()))
    order = np.lexsort((times, senders))
    places = np.searchsorted(senders[order], np.arange(1, size))
    return SpikeTrains(np.split(times[order], places), start_s, end_s)


def _joined(column: npt.NDArray[Any]) -> Floats:
    """The elements of all packets: a row each, or objects where they have different lengths."""
    parts = [np.asarray(each, np.float64).ravel() for each in column]
    return np.concatenate(parts) if parts else np.zeros(0)
