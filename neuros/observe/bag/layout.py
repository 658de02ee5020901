"""Where the numbers of a serialised message are, so that NumPy can take them from many at once.

A message of fixed size has its numbers always at the same places. One with strings and sequences
has them where a message with the same lengths has them; and most topics repeat a few lengths for
ever, like a ``frame_id``. So a layout is worked out from one message, and serves all that have the
same lengths at the same places (plain CDR: OMG DDSI-RTPS 2.5, 10.2).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

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
    """What has no such layout: sequences of messages or strings, wide strings, big-endian data."""


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
