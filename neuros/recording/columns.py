"""Recorded messages as columns of NumPy.

NumPy reads columns from the bytes of messages. The place of a number depends on the lengths of
strings and sequences in front of it, and most topics repeat a few lengths, as of a ``frame_id``. So
a layout is computed from one message, and serves all messages with the same lengths (plain CDR: OMG
DDSI-RTPS 2.5, 10.2).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from math import prod
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from rosbags.typesys.store import Typestore

from neuros.errors import EnvironmentFault

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
_MULTI_ARRAY_LAYOUT = "std_msgs/msg/MultiArrayLayout"
_EMPTY = "structure_needs_at_least_one_member"
_BASE, _NAME, _ARRAY = 1, 2, 3
_MOST_LAYOUTS = 64
PIXELS = {
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
"""By encoding of images: the type of a pixel's values, and its channels."""


class _Irregular(Exception):
    """Data without a layout: sequences of messages or strings, wide strings, big-endian data."""


class _Layout:
    """The places of fields in a message, in bytes from its start, for all with the same lengths.

    Args:
        types: the field definitions of a ``rosbags`` type store.

    Attributes:
        numbers: name, NumPy type (with its shape) and place of each number or row of numbers.
        texts: name, place and length of each string.
        lengths: places of the lengths of strings and sequences.
        sizes: name and dimensions of each layout of a ``MultiArray``; its numbers have that shape.

    Raises:
        _Irregular: if the message has no layout.
    """

    def __init__(self, data: bytes, type_name: str, types: Mapping[str, Any]) -> None:
        if data[: len(_CDR_HEADER)] != _CDR_HEADER:
            raise _Irregular
        self.numbers: list[tuple[str, np.dtype[Any], int]] = []
        self.texts: list[tuple[str, int, int]] = []
        self.lengths: list[int] = []
        self.sizes: list[tuple[str, npt.NDArray[np.int64]]] = []
        self._shape: tuple[int, ...] = ()
        self._data = data
        self._types = types
        self._at = len(_CDR_HEADER)
        self._message(type_name, "")

    def _message(self, type_name: str, prefix: str) -> None:
        for name, (kind, details) in self._types[type_name][1]:
            if name.startswith(_EMPTY):
                self._at += 1
            elif kind.value == _BASE and details[0] == "string":
                size = self._length()
                self.texts.append((f"{prefix}{name}", self._at, max(0, size - 1)))
                self._at += size
            elif kind.value == _BASE:
                self._number(f"{prefix}{name}", details[0], ())
            elif kind.value == _NAME and details == _MULTI_ARRAY_LAYOUT:
                self._layout(f"{prefix}{name}.")
            elif kind.value == _NAME:
                self._message(details, f"{prefix}{name}.")
            elif kind.value == _ARRAY:
                self._row(f"{prefix}{name}", details[0], details[1], is_array=True)
            else:
                self._row(f"{prefix}{name}", details[0], self._length(), is_array=False)

    def _layout(self, prefix: str) -> None:
        """The dimensions of the numbers that follow: messages with others have other columns."""
        shape = []
        for _ in range(self._length()):
            label_bytes = self._length()
            self._at += label_bytes
            shape.append(self._length())
            self._length()  # its stride
            if self._at > len(self._data):
                raise _Irregular
        self._shape = tuple(shape)
        self.sizes.append((f"{prefix}dim", np.array(shape, np.int64)))
        self._number(f"{prefix}data_offset", "uint32", ())

    def _row(self, name: str, element: Any, count: int, *, is_array: bool) -> None:
        kind, details = element[0].value, element[1]
        shape, self._shape = self._shape, ()
        if kind == _BASE and details[0] in _NUMBERS:
            self._number(name, details[0], shape if shape and prod(shape) == count else (count,))
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
        count, size = table.shape
        columns: dict[str, Column] = {n: np.tile(sizes, (count, 1)) for n, sizes in self.sizes}
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

    Fields of messages within the message have names with dots, ``header.stamp.sec``. The column of
    an array of numbers has more than one dimension, as has that of sequences of one length. Strings
    are ``str``. Other fields (sequences of different length, or of messages) are objects. The
    numbers of a ``MultiArray`` have the shape of its layout, whose ``dim`` is its sizes.
    """
    if not packets:
        try:  # the layout of a message whose strings and sequences are empty
            layout = _Layout(_CDR_HEADER, type_name, store.fielddefs)
        except _Irregular:
            ways = fields_of(type_name, store.fielddefs)
            return {".".join(name for _, name in way): np.empty(0, object) for way in ways}
        numbers = {name: np.zeros((0, *kind.shape), kind.base) for name, kind, _ in layout.numbers}
        return numbers | {name: np.zeros(0, "U1") for name, _, _ in layout.texts}
    found: dict[str, list[tuple[npt.NDArray[np.intp], Column]]] = {}
    for rows, columns in _parts(packets, type_name, store):
        for name, column in columns.items():
            found.setdefault(name, []).append((rows, column))
    return {name: _join(parts, len(packets)) for name, parts in found.items()}


def _parts(
    packets: Sequence[bytes], type_name: str, store: Typestore
) -> Iterator[tuple[npt.NDArray[np.intp], dict[str, Column]]]:
    """Rows and columns of each group of messages with one layout; last, of those without one."""
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
        made = {}
        for name, values in columns.items():
            is_scalar = isinstance(values[0], (bool, int, float, str, np.generic))
            made[name] = np.array(values) if is_scalar else np.empty(len(values), object)
            if not is_scalar:  # NumPy would make arrays of several dimensions of rows of one length
                for place, value in enumerate(values):
                    made[name][place] = value
        yield rows, made


def _flat(message: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name in message.__dataclass_fields__:
        value = getattr(message, name)
        if hasattr(value, "__dataclass_fields__"):
            yield from _flat(value, f"{prefix}{name}.")
        elif name != "__msgtype__":
            yield f"{prefix}{name}", value


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


def library(name: str, otherwise: str = "") -> Any:
    """Import an optional library.

    Args:
        otherwise: what works without the library, for the error.

    Raises:
        EnvironmentFault: if it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        text = f"{name} is not installed for {sys.executable}: pip install {name}"
        raise EnvironmentFault(f"{text}, or use {otherwise}" if otherwise else text) from error


def has_simulated_time(columns: Mapping[str, Column]) -> bool:
    """Whether the publish time of packets is not their wall time."""
    return bool(np.any(columns[PUBLISH_TIME] != columns[LOG_TIME]))


def fields_of(
    type_name: str, types: Mapping[str, Any], path: tuple[tuple[str, str], ...] = ()
) -> Iterator[tuple[tuple[str, str], ...]]:
    """The way to each field: pairs of message type and field, from the outermost type on."""
    for name, (_, details) in types[type_name][1]:
        way = (*path, (type_name, name))
        if isinstance(details, str) and details in types:
            yield from fields_of(details, types, way)
        elif not name.startswith(_EMPTY):
            yield way


def pixels_of(columns: Mapping[str, Column], prefix: str) -> Column | None:
    """Images ``(time, y, x[, channel])``; ``None`` unless all have one size and known pixels."""
    data = columns[f"{prefix}data"]
    about = [columns[f"{prefix}{name}"] for name in ("height", "width", "step", "is_bigendian")]
    encodings = columns[f"{prefix}encoding"]
    varies = any(len(np.unique(column)) != 1 for column in (encodings, *about))
    if data.ndim != 2 or varies or str(encodings[0]) not in PIXELS:
        return None
    height, width, step, is_bigendian = (int(column[0]) for column in about)
    kind, channels = PIXELS[str(encodings[0])]
    value = np.dtype(kind).newbyteorder(">" if is_bigendian else "<")
    used = width * max(1, len(channels)) * value.itemsize
    if step < used or data.shape[1] != height * step:
        return None
    rows = np.ascontiguousarray(data.reshape(len(data), height, step)[:, :, :used])
    pixels: Column = rows.view(value).astype(value.newbyteorder("="), copy=False)
    return pixels.reshape((len(data), height, width, *([len(channels)] if channels else [])))
