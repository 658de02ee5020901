"""Messages to bytes and back as DDS carries them, without rclpy's detour over C structures.

For a small message rclpy spends most of the time on looking up Python classes from C. Here the
layout of a message class is worked out once: runs of numbers become one ``struct`` each, and only
strings and sequences are looked at one by one. The encoding is the same (plain CDR, little-
endian: OMG DDSI-RTPS 2.5, 10.2, and CORBA 3.3, part 2, 9.3), but gaps are filled with zeros.
What is written has been checked (:mod:`neuros.transport.values`). Whatever is out of the ordinary,
in a class or in bytes, is left to rclpy, and so are errors: single characters, more items than a
bound allows, senders of the other byte order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import cache
from struct import Struct
from typing import Any, TypeAlias

from neuros.transport.cdr_parts import (
    START,
    Array,
    Buffer,
    Items,
    Nothing,
    Numbers,
    Part,
    Pieces,
    ReadItem,
    Text,
    Unusual,
    WriteItem,
    read_text,
    read_wide_text,
    write_text,
    write_wide_text,
)
from neuros.transport.schema import Leaf, Shape, Sort, Type, schema

Encode: TypeAlias = Callable[[Any], bytes]
Decode: TypeAlias = Callable[[bytes], Any]

_HEADER = b"\0\1\0\0"


@cache
def cdr(kind: type) -> tuple[Encode, Decode] | None:
    """What encodes and decodes messages of a class; ``None`` where only rclpy can.

    Both raise one of ``NOT_OURS`` where a message is to be left to rclpy.
    """
    try:
        parts = _parts_of(kind)
    except Unusual:
        return None
    return _encoder(kind, parts), _decoder(kind, parts)


@cache
def _parts_of(kind: Any) -> tuple[Part, ...]:
    return tuple(_parts(_entries(kind, iter(schema(kind).leaves))))


def _entries(kind: Any, leaves: Iterator[Leaf]) -> Iterator[Leaf | None]:
    """The leaves of a message, in their order; ``None`` for a message without fields."""
    fields = schema(kind).fields
    if not fields:
        yield None
    for field in fields:
        if field.is_message:
            yield from _entries(field.type.message, leaves)
        else:
            yield next(leaves)


def _parts(entries: Iterable[Leaf | None]) -> Iterator[Part]:
    run: list[Leaf] = []
    for leaf in entries:
        if leaf and leaf.field.shape is Shape.SINGLE and leaf.field.type.code:
            run.append(leaf)
            continue
        if run:
            yield Numbers(run)
        run = []
        yield _part(leaf) if leaf else Nothing()
    if run:
        yield Numbers(run)


def _part(leaf: Leaf) -> Part:
    field = leaf.field
    if field.shape is Shape.BUFFER:
        return Buffer(leaf)
    if field.shape is Shape.ARRAY:
        return Array(leaf)
    if field.shape is Shape.LIST:
        return Items(leaf, *_item(field.type))
    if field.type.sort is Sort.TEXT:
        return Text(leaf, write_text, read_text)
    if field.type.sort is Sort.WIDE_TEXT:
        return Text(leaf, write_wide_text, read_wide_text)
    raise Unusual


def _item(of: Type) -> tuple[WriteItem, ReadItem]:
    """What writes and reads one of several values that are no numbers."""
    if of.sort is Sort.MESSAGE:
        return _message(of.message)
    if of.sort is Sort.TEXT:
        return write_text, read_text
    if of.sort is Sort.WIDE_TEXT:
        return write_wide_text, read_wide_text
    if of.code:
        return _single(of.code)
    raise Unusual


def _message(kind: Any) -> tuple[WriteItem, ReadItem]:
    parts = _parts_of(kind)
    writers = [part.write for part in parts]

    def write(message: Any, pieces: Pieces, at: int) -> int:
        for write_part in writers:
            at = write_part(message, pieces, at)
        return at

    return (writers[0] if len(writers) == 1 else write), _reader(kind, parts)


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
    layout = Struct(f"<{code}")

    def write(value: Any, pieces: Pieces, at: int) -> int:
        pieces.append(layout.pack(value))
        return at + 1

    def read(data: bytes, at: int) -> tuple[Any, int]:
        return layout.unpack_from(data, at + START)[0], at + 1

    return write, read


def _encoder(kind: type, parts: tuple[Part, ...]) -> Encode:
    writers = tuple(part.write for part in parts)

    def encode(message: Any) -> bytes:
        if type(message) is not kind:
            raise Unusual
        pieces: Pieces = [_HEADER]
        at = 0
        for write in writers:
            at = write(message, pieces, at)
        return b"".join(pieces)

    return encode


def _decoder(kind: Any, parts: tuple[Part, ...]) -> Decode:
    read = _reader(kind, parts)

    def decode(data: bytes) -> Any:
        if data[:START] != _HEADER:
            raise Unusual
        message, _ = read(data, 0)
        return message

    return decode
