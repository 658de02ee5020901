"""Columns of many messages of one type, taken from their bytes by NumPy.

A message of fixed size has its numbers always at the same places. One with strings and sequences
has them where a message with the same lengths has them; and most topics repeat a few lengths for
ever, like a ``frame_id``. So a layout is worked out from one message, and serves all that have the
same lengths at the same places (plain CDR: OMG DDSI-RTPS 2.5, 10.2).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

Fields: TypeAlias = "Mapping[str, Any]"

HEADER_BYTES = 4
LITTLE_ENDIAN = b"\0\1\0\0"
_NUMBERS = {
    "bool": "?", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "<i2",
    "uint16": "<u2", "int32": "<i4", "uint32": "<u4", "int64": "<i8", "uint64": "<u8",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip
_EMPTY = "structure_needs_at_least_one_member"
_BASE, _NAME, _ARRAY, _SEQUENCE = 1, 2, 3, 4


class Irregular(Exception):
    """Data without a layout: sequences of messages or strings, wide strings, big-endian data."""


@dataclass
class Layout:
    """The places in a message, counted from the beginning of its header.

    Attributes:
        numbers: name, NumPy type (with its shape) and place of each number or row of numbers.
        texts: name, place and length of each string.
        lengths: places of the lengths that all this depends on.
        variable: names of what has another shape in another layout.
    """

    numbers: list[tuple[str, Any, int]] = field(default_factory=list)
    texts: list[tuple[str, int, int]] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    variable: set[str] = field(default_factory=set)


def layout_of(data: bytes, type_name: str, types: Mapping[str, Any]) -> Layout:
    """The layout of a message, and of all with the same lengths.

    Args:
        types: the field definitions of a ``rosbags`` type store.

    Raises:
        Irregular: if it has none.
    """
    if data[:HEADER_BYTES] != LITTLE_ENDIAN:
        raise Irregular
    walk = _Walk(data, types)
    walk.message(type_name, "")
    return walk.layout


def field_names(type_name: str, types: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """The names of all fields, those of messages within the message with dots."""
    for name, (kind, details) in types[type_name][1]:
        if kind.value == _NAME:
            yield from field_names(details, types, f"{prefix}{name}.")
        elif not name.startswith(_EMPTY):
            yield f"{prefix}{name}"


class _Walk:
    """Goes through one message from its beginning to its end."""

    def __init__(self, data: bytes, types: Mapping[str, Any]) -> None:
        self._data = data
        self._types = types
        self._at = 0
        self.layout = Layout()

    def message(self, type_name: str, prefix: str) -> None:
        for name, (kind, details) in self._types[type_name][1]:
            if not name.startswith(_EMPTY):
                self._field(f"{prefix}{name}", kind.value, details)
            else:
                self._at += 1

    def _field(self, name: str, kind: int, details: Any) -> None:
        if kind == _BASE:
            self._base(name, details[0])
        elif kind == _NAME:
            self.message(details, f"{name}.")
        elif kind == _ARRAY:
            self._row(name, details[0], details[1])
        else:
            count = self._length()
            self.layout.variable.add(name)
            self._row(name, details[0], count)

    def _base(self, name: str, type_name: str) -> None:
        if type_name == "string":
            size = self._length()
            self.layout.texts.append((name, self._at + HEADER_BYTES, max(0, size - 1)))
            self._at += size
        else:
            self._number(name, type_name, ())

    def _row(self, name: str, element: Any, count: int) -> None:
        kind, details = element[0].value, element[1]
        if kind != _BASE or details[0] not in _NUMBERS:
            if count == 0:
                self._number(name, "uint8", (0,))
                return
            if kind != _NAME or name in self.layout.variable:
                raise Irregular
            for place in range(count):
                self.message(details, f"{name}[{place}].")
            return
        self._number(name, details[0], (count,))

    def _number(self, name: str, type_name: str, shape: tuple[int, ...]) -> None:
        if type_name not in _NUMBERS:
            raise Irregular
        kind = np.dtype(_NUMBERS[type_name])
        if shape != (0,):
            self._align(kind.itemsize)
        self.layout.numbers.append((name, np.dtype((kind, shape)), self._at + HEADER_BYTES))
        self._at += kind.itemsize * (shape[0] if shape else 1)

    def _length(self) -> int:
        self._align(4)
        place = self._at + HEADER_BYTES
        self.layout.lengths.append(place)
        self._at += 4
        return int.from_bytes(self._data[place : place + 4], "little")

    def _align(self, size: int) -> None:
        self._at += -self._at % size


Column = npt.NDArray[Any]

_MOST_LAYOUTS = 64


class TypeStore(Protocol):
    """Part of ``rosbags.typesys.store.Typestore`` that is used here."""

    @property
    def fielddefs(self) -> Mapping[str, Any]: ...
    def deserialize_cdr(self, rawdata: bytes, typename: str) -> Any: ...


def columns_of(packets: Sequence[bytes], type_name: str, store: TypeStore) -> dict[str, Column]:
    """One column for each field, with one row for each message.

    Fields of messages within the message have names with dots, ``header.stamp.sec``. Arrays of
    numbers have a column with more than one dimension; so have sequences, where all are of the same
    length. Strings are ``str``. What is left (sequences of different length, or of messages) is in
    a column of objects.
    """
    if not packets:
        return _of_none(type_name, store)
    found: dict[str, list[tuple[npt.NDArray[np.intp], Column]]] = {}
    for rows, columns in _parts(packets, type_name, store):
        for name, column in columns.items():
            found.setdefault(name, []).append((rows, column))
    return {name: _join(parts, len(packets)) for name, parts in found.items()}


def _of_none(type_name: str, store: TypeStore) -> dict[str, Column]:
    """The columns of no message: those of one whose strings and sequences are empty."""
    try:
        layout = layout_of(LITTLE_ENDIAN, type_name, store.fielddefs)
    except Irregular:
        return {name: np.empty(0, object) for name in field_names(type_name, store.fielddefs)}
    numbers = {name: np.zeros((0, *kind.shape), kind.base) for name, kind, _ in layout.numbers}
    return numbers | {name: np.zeros(0, "U1") for name, _, _ in layout.texts}


def _parts(
    packets: Sequence[bytes], type_name: str, store: TypeStore
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
                    raise Irregular
                layout = layout_of(table[0].tobytes(), type_name, store.fielddefs)
            except (Irregular, IndexError):
                rest.append(rows)
                break
            layouts += 1
            fits = _fits(table, layout)
            yield rows[fits], _take(np.ascontiguousarray(table[fits]), layout)
            rows, table = rows[~fits], table[~fits]
    if rest:
        rows = np.concatenate(rest)
        yield rows, _one_by_one([packets[row] for row in rows.tolist()], type_name, store)


def _fits(table: Column, layout: Layout) -> npt.NDArray[np.bool_]:
    fits = np.ones(len(table), np.bool_)
    for place in layout.lengths:
        fits &= (table[:, place : place + 4] == table[0, place : place + 4]).all(axis=1)
    fits &= (table[:, :4] == table[0, :4]).all(axis=1)
    return fits


def _take(table: Column, layout: Layout) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    size = table.shape[1]
    for name, kind, place in layout.numbers:
        view = np.dtype({"names": ["x"], "formats": [kind], "offsets": [place], "itemsize": size})
        columns[name] = table.view(view)["x"][:, 0] if kind.itemsize else _empty(len(table), kind)
    for name, place, length in layout.texts:
        if length:
            raw = np.ascontiguousarray(table[:, place : place + length]).view(f"S{length}")[:, 0]
            columns[name] = np.char.decode(raw, "utf-8", "replace")
        else:
            columns[name] = np.zeros(len(table), "U1")
    return columns


def _empty(count: int, kind: np.dtype[Any]) -> Column:
    return np.zeros((count, 0), kind.base)


def _one_by_one(packets: Sequence[bytes], type_name: str, store: TypeStore) -> dict[str, Column]:
    columns: dict[str, list[Any]] = {}
    for data in packets:
        for name, value in _flat(store.deserialize_cdr(data, type_name), ""):
            columns.setdefault(name, []).append(value)
    return {name: _objects_or_numbers(values) for name, values in columns.items()}


def _flat(message: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name in message.__dataclass_fields__:
        if name == "__msgtype__":
            continue
        value = getattr(message, name)
        if hasattr(value, "__dataclass_fields__"):
            yield from _flat(value, f"{prefix}{name}.")
        else:
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
        if len(parts) == 1 and len(parts[0][0]) == count:
            joined = np.empty_like(parts[0][1])
        else:
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
