"""The parts of a message in CDR: runs of numbers, strings, sequences and arrays.

Each part knows the places of its fields in the message, and how they are written and read. Places
in the bytes are counted from behind the header: CDR puts a number at a multiple of its size.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

Pieces: TypeAlias = "list[Any]"

START = 4
"""Bytes of the header."""

CODES = {
    "boolean": "?", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float": "f", "double": "d",
}  # fmt: skip
"""Types of single numbers in ROS's notation, as ``struct`` calls them."""

_LENGTH = struct.Struct("<I")
_PADDING = tuple(bytes(size) for size in range(8))


class Unusual(Exception):
    """What is left to rclpy."""


NOT_OURS = (Unusual, struct.error, AttributeError, TypeError, ValueError, OverflowError)
"""What writing and reading raise for a message that is to be left to rclpy."""


class Field(NamedTuple):
    """A field of a message or of one within it: the slots that lead there, and what it holds."""

    path: tuple[str, ...]
    type_name: str
    default: Any


class Part:
    """Some fields that follow each other: ``targets`` are their slots in the message."""

    def __init__(self, fields: list[Field]) -> None:
        self.targets = tuple(field.path for field in fields)
        self.get: Callable[[Any], Any] = attrgetter(*(".".join(path) for path in self.targets))

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        """Append the bytes for place ``at``; returns the place behind them."""
        raise NotImplementedError

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        """Append the values at a place, one for each target; returns the place behind them."""
        raise NotImplementedError


class Numbers(Part):
    def __init__(self, fields: list[Field]) -> None:
        super().__init__(fields)
        if len(fields) == 1:
            get = self.get
            self.get = lambda message: (get(message),)
        codes = [CODES[field.type_name] for field in fields]
        self._layouts = tuple(_aligned(codes, at) for at in range(8))

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        layout = self._layouts[at & 7]
        pieces.append(layout.pack(*self.get(message)))
        return at + layout.size

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        layout = self._layouts[at & 7]
        values += layout.unpack_from(data, at + START)
        return at + layout.size


class Text(Part):
    def __init__(self, field: Field) -> None:
        super().__init__([field])

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        return _write_text(self.get(message), pieces, at)

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        text, end = _read_text(data, at)
        values.append(text)
        return end


class Texts(Part):
    def __init__(self, field: Field) -> None:
        super().__init__([field])

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        texts = self.get(message)
        if type(texts) is not list:
            raise Unusual
        at = _write_length(len(texts), pieces, at)
        for text in texts:
            at = _write_text(text, pieces, at)
        return at

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        texts, (count, at) = [], _read_length(data, at)
        for _ in range(count):
            text, at = _read_text(data, at)
            texts.append(text)
        values.append(texts)
        return at


class Sequence(Part):
    """Numbers without a bound: an ``array.array``."""

    def __init__(self, field: Field) -> None:
        super().__init__([field])
        self._code = field.default.typecode
        self._size: int = field.default.itemsize

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        values = self.get(message)
        if type(values) is not array or values.typecode != self._code:
            raise Unusual
        at = _write_length(len(values), pieces, at)
        if not values:
            return at
        padding = -at % self._size
        pieces += (_PADDING[padding], values)
        return at + padding + len(values) * self._size

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        count, at = _read_length(data, at)
        numbers = array(self._code)
        if count:
            at += -at % self._size
            end = at + count * self._size
            if end + START > len(data):
                raise Unusual
            numbers.frombytes(memoryview(data)[at + START : end + START])
            at = end
        values.append(numbers)
        return at


class Array(Part):
    """A fixed number of numbers: an array of NumPy."""

    def __init__(self, field: Field) -> None:
        super().__init__([field])
        default = field.default
        if not default.dtype.isnative or not default.size:
            raise Unusual
        self._default = default
        self._kind, self._dtype, self._shape = type(default), default.dtype, default.shape
        self._item: int = default.itemsize
        self._size: int = default.nbytes

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        values = self.get(message)
        if (
            type(values) is not self._kind
            or values.dtype != self._dtype
            or values.shape != self._shape
        ):
            raise Unusual
        padding = -at % self._item
        pieces += (_PADDING[padding], values.tobytes())
        return at + padding + self._size

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        at += -at % self._item
        end = at + self._size
        numbers = self._default.copy()
        memoryview(numbers).cast("B")[:] = data[at + START : end + START]
        values.append(numbers)
        return end


def _aligned(codes: list[str], at: int) -> struct.Struct:
    """Each number at a multiple of its size, if the first byte is at place ``at``."""
    layout, start = "<", at
    for code in codes:
        size = struct.calcsize(f"<{code}")
        padding = -at % size
        layout += f"{padding}x{code}"
        at += padding + size
    made = struct.Struct(layout)
    assert made.size == at - start
    return made


def _write_length(length: int, pieces: Pieces, at: int) -> int:
    padding = -at & 3
    pieces.append(_PADDING[padding] + _LENGTH.pack(length))
    return at + padding + 4


def _read_length(data: bytes, at: int) -> tuple[int, int]:
    at += -at & 3
    return _LENGTH.unpack_from(data, at + START)[0], at + 4


def _write_text(text: Any, pieces: Pieces, at: int) -> int:
    """In UTF-8 with a NUL behind it; after a NUL within, ROS sends nothing."""
    if type(text) is not str or "\0" in text:
        raise Unusual
    encoded = text.encode()
    padding, length = -at & 3, len(encoded) + 1
    pieces.append(_PADDING[padding] + _LENGTH.pack(length) + encoded + b"\0")
    return at + padding + 4 + length


def _read_text(data: bytes, at: int) -> tuple[str, int]:
    length, at = _read_length(data, at)
    end = at + length
    encoded = data[at + START : end + START]
    if len(encoded) != length or encoded.find(0) != length - 1:
        raise Unusual
    return encoded[:-1].decode(errors="replace"), end
