"""Codecs: a packet to the bytes that its data topic carries, and back.

The transport publishes and receives bytes only. So what is behind them can differ between two
connections of one output, and a packet is serialised once for all receivers with one codec.

NeuROS writes and reads CDR without rclpy's detour over C structures: for a small message rclpy
spends most of the time on looking up Python classes from C. Here the
layout of a message class is worked out once: runs of numbers become one ``struct`` each, and only
strings and sequences are encoded one by one. The encoding is that of rclpy (plain CDR,
little-endian: OMG DDSI-RTPS 2.5, 10.2, and CORBA 3.3, part 2, 9.3), but gaps are filled with zeros.
Messages have been checked before (:mod:`neuros.transport.values`). Unusual classes and bytes are
left to rclpy: single characters, what a plugin made of a message, senders of the other byte order.

Anybody in the domain may publish anything: what is no message is a :class:`WrongBytes`, and takes
no memory for more items than there are bytes.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from math import prod
from operator import attrgetter
from typing import Any, Protocol, TypeAlias

import numpy
from rclpy.serialization import deserialize_message, serialize_message

from neuros.errors import ProtocolError
from neuros.project.message_types import ArrayType
from neuros.transport.schema import Leaf, Shape, Sort, Type, schema


class WrongBytes(ProtocolError):
    """Bytes that are no packet of the type of their topic."""

    def __init__(self, kind: type | ArrayType, data: bytes, why: object) -> None:
        name = str(kind)
        if isinstance(kind, type):
            name = f"{kind.__module__.partition('.')[0]}/{kind.__name__}"
        super().__init__(f"{len(data)} bytes are not a {name}: {why}")


PARCEL_MARK = b"NR"
"""Option bytes of the encapsulation header of a parcel (:mod:`neuros.transport.large_packets`)."""
COMPRESSED_MARK = b"NZ"
"""Those of a compressed packet (:mod:`neuros.transport.envelope`)."""


class Encoder(Protocol):
    """The sender's half of a codec; connections of one output share it where they can."""

    def encode(self, packet: Any) -> bytes:
        """Serialise a packet, which may change as soon as this returns."""


class Decoder(Protocol):
    """The receiver's half of a codec."""

    def decode(self, data: bytes) -> Any:
        """The packet that was published as ``data``; ``None`` if it was lost on its way.

        Raises:
            WrongBytes: if they are none.
        """


class Codec(Encoder, Decoder, Protocol):
    """One way to carry packets."""


class MessageCodec:
    """Messages as ROS serialises them: what every ROS node understands."""

    def __init__(self, kind: type) -> None:
        self._kind = kind

    def encode(self, packet: Any) -> bytes:
        data: bytes = serialize_message(packet)
        return data

    def decode(self, data: bytes) -> Any:
        try:
            return deserialize_message(data, self._kind)
        except Exception as error:  # rclpy does not say which
            raise WrongBytes(self._kind, data, error) from error


class CdrCodec(MessageCodec):
    """Messages in plain CDR by NeuROS itself, in a fraction of the time; the rest by rclpy."""

    def __init__(self, kind: type, parts: tuple[Part, ...]) -> None:
        super().__init__(kind)
        self._writers = tuple(part.write for part in parts)
        self._read = _reader(kind, parts)

    def encode(self, packet: Any) -> bytes:
        try:
            if type(packet) is not self._kind:
                raise Unusual
            pieces: Pieces = [HEADER]
            at = 0
            for write in self._writers:
                at = write(packet, pieces, at)
            return b"".join(pieces)
        except _NOT_OURS:
            return super().encode(packet)

    def decode(self, data: bytes) -> Any:
        if data[:_START] != HEADER:
            return super().decode(data)
        try:
            return self._read(data, 0)[0]
        except (struct.error, ValueError) as error:
            raise WrongBytes(self._kind, data, error) from error


class ArrayCodec:
    """Arrays of one type as messages of ``std_msgs``: all have the same bytes before the numbers.

    A message of another program may name its dimensions, or leave the layout out.

    Attributes:
        rest: the message without its numbers.
    """

    def __init__(self, kind: ArrayType) -> None:
        from std_msgs import msg

        message = getattr(msg, kind.message.rpartition("/")[2])
        self._kind, self._plain = kind, message_codec(message)
        self._dtype, self._is_bool = numpy.dtype(kind.dtype), kind.dtype == "bool"
        example = message()
        for place, size in enumerate(kind.shape):
            dimension = msg.MultiArrayDimension(size=size, stride=prod(kind.shape[place:]))
            example.layout.dim.append(dimension)
        self.rest = self._plain.encode(example)
        code = "B" if self._is_bool else self._dtype.char
        self.typecode = next(c for c in "bBhHiIqQfd" if numpy.dtype(c) == numpy.dtype(code))
        example.data = array(self.typecode, bytes(self._dtype.itemsize))
        first = self._plain.encode(example)
        self._prefix = (
            self.rest[: -_LENGTH.size]
            + _LENGTH.pack(kind.size)
            + first[len(self.rest) : -self._dtype.itemsize]
        )
        self._end = len(self._prefix) + kind.nbytes

    def encode(self, packet: Any) -> bytes:
        data: bytes = self._prefix + packet.tobytes()
        return data

    def decode(self, data: bytes) -> Any:
        """A read-only array."""
        # DDS pads a message to a multiple of four bytes.
        if data.startswith(self._prefix) and 0 <= len(data) - self._end < 4:
            return self.of_numbers(data, len(self._prefix))
        message = self._plain.decode(data)
        if (why := self._misfit(message)) is not None:
            raise WrongBytes(self._kind, data, why)
        return self.of_numbers(message.data, 0)

    def of_numbers(self, data: Any, start: int) -> Any:
        """The array with these bytes from ``start`` on, without a copy where they are aligned."""
        found: Any = numpy.ndarray(self._kind.shape, self._dtype, data, start)
        if self._is_bool and (found.view(numpy.uint8) > 1).any():
            raise WrongBytes(self._kind, data, "it has numbers other than 0 and 1")
        if not found.flags.aligned:
            found = found.copy()
        found.flags.writeable = False
        return found

    def _misfit(self, message: Any) -> str | None:
        """Why a message holds no array of the type; ``None`` if it does."""
        shape, dimensions = self._kind.shape, message.layout.dim
        sizes = tuple(each.size for each in dimensions)
        strides = [each.stride for each in dimensions]
        if sizes and sizes != shape:
            return f"its layout is {','.join(map(str, sizes))}"
        if any(strides) and strides != [prod(shape[place:]) for place in range(len(shape))]:
            return f"its strides are {','.join(map(str, strides))}, not those of C"
        if message.layout.data_offset:
            return f"its numbers begin at {message.layout.data_offset}, not at 0"
        if len(message.data) != self._kind.size:
            return f"it has {len(message.data)} numbers"
        return None


@cache
def array_codec(kind: ArrayType) -> ArrayCodec:
    return ArrayCodec(kind)


@cache
def message_codec(kind: Any) -> Codec:
    """The plain codec for a message class, or for the arrays of a type."""
    if isinstance(kind, ArrayType):
        return array_codec(kind)
    try:
        return CdrCodec(kind, _parts_of(kind))
    except Unusual:
        return MessageCodec(kind)


# ---------------------------------------------------------------------- CDR

Pieces: TypeAlias = "list[Any]"
WriteItem: TypeAlias = Callable[[Any, Pieces, int], int]
ReadItem: TypeAlias = Callable[[bytes, int], "tuple[Any, int]"]

HEADER = b"\0\1\0\0"
"""The encapsulation header of plain CDR, little-endian."""
_START = len(HEADER)

_LENGTH = struct.Struct("<I")
_LENGTHS = tuple(struct.Struct(f"<{padding}xI") for padding in range(4))
_PADDING = tuple(bytes(size) for size in range(8))


class Unusual(Exception):
    """A message or its class is left to rclpy."""


_NOT_OURS = (Unusual, struct.error, AttributeError, TypeError, ValueError, OverflowError)
"""Writing raises these for a message that is left to rclpy."""


@cache
def _parts_of(kind: Any) -> tuple[Part, ...]:
    return tuple(_parts(schema(kind).encoded))


def _parts(entries: Iterable[Leaf | None]) -> Iterator[Part]:
    run: list[Leaf] = []
    for leaf in entries:
        if leaf and leaf.field.shape is Shape.SINGLE and leaf.field.type.code:
            run.append(leaf)
            continue
        if run:
            yield Numbers(run)
        run = []
        yield _PARTS[leaf.field.shape](leaf) if leaf else Nothing()
    if run:
        yield Numbers(run)


def _item(of: Type) -> tuple[WriteItem, ReadItem]:
    """Writer and reader of a value that is no number."""
    if of.sort is Sort.MESSAGE:
        parts = _parts_of(of.message)
        writers = [part.write for part in parts]

        def write(message: Any, pieces: Pieces, at: int) -> int:
            for write_part in writers:
                at = write_part(message, pieces, at)
            return at

        return (writers[0] if len(writers) == 1 else write), _reader(of.message, parts)
    if of.sort is Sort.TEXT:
        return write_text, read_text
    if of.sort is Sort.WIDE_TEXT:
        return write_wide_text, read_wide_text
    if of.code:
        return _single(of.code)
    raise Unusual


def _reader(kind: Any, parts: tuple[Part, ...]) -> ReadItem:
    layout = schema(kind)
    kinds, fill, fixed = layout.kinds, layout.fill, [value for *_, value in layout.switches]
    readers = tuple(part.read for part in parts)

    def read(data: bytes, at: int) -> tuple[Any, int]:
        made = list(map(object.__new__, kinds))
        values = made[1:] + fixed
        for read_part in readers:
            at = read_part(data, at, values)
        fill(made, values)
        return made[0], at

    return read


def _single(code: str) -> tuple[WriteItem, ReadItem]:
    """For a bool or a byte."""
    layout = struct.Struct(f"<{code}")

    def write(value: Any, pieces: Pieces, at: int) -> int:
        pieces.append(layout.pack(value))
        return at + 1

    def read(data: bytes, at: int) -> tuple[Any, int]:
        return layout.unpack_from(data, at + _START)[0], at + 1

    return write, read


class Part:
    """Some fields that follow each other: where they are in a message, and their encoding.

    Places in the bytes count from the end of the header. CDR puts a number at a multiple of its
    size.
    """

    def __init__(self, leaves: Sequence[Leaf]) -> None:
        self.get: Callable[[Any], Any] = attrgetter(*(".".join(leaf.path) for leaf in leaves))

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        """Append the bytes for place ``at``; returns the place behind them."""
        raise NotImplementedError

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        """Append the values at a place, one for each field; returns the place behind them."""
        raise NotImplementedError


class Numbers(Part):
    """Single numbers, bools and bytes."""

    def __init__(self, leaves: Sequence[Leaf]) -> None:
        super().__init__(leaves)
        codes = [leaf.field.type.code for leaf in leaves]
        self._has_several = len(codes) > 1
        self._layouts = tuple(_aligned(codes, at) for at in range(8))

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        layout, values = self._layouts[at & 7], self.get(message)
        pieces.append(layout.pack(*values) if self._has_several else layout.pack(values))
        return at + layout.size

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        layout = self._layouts[at & 7]
        values += layout.unpack_from(data, at + _START)
        return at + layout.size


class Nothing(Part):
    """A message without fields, for which ROS puts a byte."""

    def __init__(self) -> None: ...

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        pieces.append(b"\0")
        return at + 1

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        return at + 1


class Text(Part):
    def __init__(self, leaf: Leaf) -> None:
        super().__init__([leaf])
        self._write, self._read = _item(leaf.field.type)

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        return self._write(self.get(message), pieces, at)

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        text, end = self._read(data, at)
        values.append(text)
        return end


class Items(Part):
    """Several values that are no numbers: a list."""

    def __init__(self, leaf: Leaf) -> None:
        super().__init__([leaf])
        self._size = leaf.field.size
        self._most = leaf.field.bound
        self._write_item, self._read_item = _item(leaf.field.type)

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        items, write_item = self.get(message), self._write_item
        if self._size is None:
            at = _write_length(len(items), pieces, at)
        for item in items:
            at = write_item(item, pieces, at)
        return at

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        items, read_item, count = [], self._read_item, self._size
        if count is None:
            count, at = _read_length(data, at, self._most)
            _check_length(data, at, count)  # each takes a byte at least
        for _ in range(count):
            item, at = read_item(data, at)
            items.append(item)
        values.append(items)
        return at


class Buffer(Part):
    """Any number of numbers: an ``array.array``."""

    def __init__(self, leaf: Leaf) -> None:
        super().__init__([leaf])
        self._code = leaf.field.type.code
        self._size = array(self._code).itemsize
        self._most = leaf.field.bound

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        values = self.get(message)
        if type(values) is not array:
            raise Unusual
        at = _write_length(len(values), pieces, at)
        if not values:
            return at
        padding = -at % self._size
        pieces += (_PADDING[padding], values)
        return at + padding + len(values) * self._size

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        count, at = _read_length(data, at, self._most)
        numbers = array(self._code)
        if count:
            at += -at % self._size
            end = at + count * self._size
            _check_length(data, at, count * self._size)
            numbers.frombytes(memoryview(data)[at + _START : end + _START])
            at = end
        values.append(numbers)
        return at


class Array(Part):
    """A fixed number of numbers: an array of NumPy."""

    def __init__(self, leaf: Leaf) -> None:
        super().__init__([leaf])
        self._default = numpy.zeros(leaf.field.size or 0, leaf.field.type.code)
        self._item = self._default.itemsize
        self._size = self._default.nbytes

    def write(self, message: Any, pieces: Pieces, at: int) -> int:
        padding = -at % self._item
        pieces += (_PADDING[padding], self.get(message).tobytes())
        return at + padding + self._size

    def read(self, data: bytes, at: int, values: list[Any]) -> int:
        at += -at % self._item
        end = at + self._size
        numbers = self._default.copy()
        memoryview(numbers).cast("B")[:] = data[at + _START : end + _START]
        values.append(numbers)
        return end


_PARTS: dict[Shape, Callable[[Leaf], Part]] = {
    Shape.SINGLE: Text,  # numbers are in runs
    Shape.BUFFER: Buffer,
    Shape.ARRAY: Array,
    Shape.LIST: Items,
}


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
    pieces.append(_LENGTHS[padding].pack(length))
    return at + padding + 4


def _read_length(data: bytes, at: int, most: int | None = None) -> tuple[int, int]:
    at += -at & 3
    length = _LENGTH.unpack_from(data, at + _START)[0]
    if most is not None and length > most:
        raise ValueError(f"{length} items where {most} are allowed")
    return length, at + 4


def _check_length(data: bytes, at: int, size: int) -> None:
    if at + _START + size > len(data):
        raise ValueError(f"{size} bytes are to begin at byte {at + _START}")


def write_text(text: str, pieces: Pieces, at: int) -> int:
    """Append text in UTF-8 with a NUL behind it; returns the place behind."""
    encoded = text.encode()
    padding, length = -at & 3, len(encoded) + 1
    pieces += (_LENGTHS[padding].pack(length), encoded, b"\0")
    return at + padding + 4 + length


def read_text(data: bytes, at: int) -> tuple[str, int]:
    """The text at a place, and the place behind it."""
    at += -at & 3
    (length,) = _LENGTH.unpack_from(data, at + _START)
    at += 4
    end = at + length
    encoded = data[at + _START : end + _START]
    if len(encoded) != length:
        _check_length(data, at, length)
    if encoded.find(0) != length - 1:  # as rclpy has it
        return str(encoded.partition(b"\0")[0], "utf-8", "replace"), end
    return str(encoded[:-1], "utf-8", "replace"), end


def write_wide_text(text: str, pieces: Pieces, at: int) -> int:
    """Append text in UTF-16, a unit in four bytes, as Fast DDS does; returns the place behind."""
    encoded = text.encode("utf-16-le")
    count = len(encoded) // 2
    at = _write_length(count, pieces, at)
    pieces.append(struct.pack(f"<{count}I", *struct.unpack(f"<{count}H", encoded)))
    return at + 4 * count


def read_wide_text(data: bytes, at: int) -> tuple[str, int]:
    """The text at a place, and the place behind it."""
    count, at = _read_length(data, at)
    _check_length(data, at, 4 * count)
    units = struct.unpack_from(f"<{count}I", data, at + _START)
    return struct.pack(f"<{count}H", *units).decode("utf-16-le"), at + 4 * count
