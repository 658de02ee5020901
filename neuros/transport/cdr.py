"""Messages to bytes and back as DDS carries them, without rclpy's detour over C structures.

For a small message rclpy spends most of the time on looking up Python classes from C. Here the
layout of a message class is worked out once: runs of numbers become one ``struct`` each, and only
strings and sequences are looked at one by one. The encoding is the same (plain CDR, little-
endian: OMG DDSI-RTPS 2.5, 10.2, and CORBA 3.3, part 2, 9.3), but gaps are filled with zeros.
Whatever is out of the ordinary, in a class or in a message, is left to rclpy, and so are errors: a
value that ROS would convert or refuse, bounded fields, wide strings, sequences of messages, senders
of the other byte order.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Iterator
from functools import cache
from operator import itemgetter
from typing import Any, TypeAlias

from neuros.transport.cdr_parts import (
    CODES,
    START,
    Array,
    Field,
    Numbers,
    Part,
    Pieces,
    Sequence,
    Text,
    Texts,
    Unusual,
)

Encode: TypeAlias = Callable[[Any], bytes]
Decode: TypeAlias = Callable[[bytes], Any]

_HEADER = b"\0\1\0\0"


@cache
def cdr(kind: type) -> tuple[Encode, Decode] | None:
    """What encodes and decodes messages of a class; ``None`` where only rclpy can.

    Both raise one of ``NOT_OURS`` where a message is to be left to rclpy.
    """
    try:
        parts = tuple(_parts(list(_fields(kind, ()))))
    except Unusual:
        return None
    return (_encoder(kind, parts), _decoder(kind, parts)) if parts else None


def _fields(kind: Any, path: tuple[str, ...]) -> Iterator[Field]:
    default = kind()
    types = kind.get_fields_and_field_types()
    if not types:  # CDR has a byte of its own for it
        raise Unusual
    for name, type_name in types.items():
        value = getattr(default, name)
        if hasattr(value, "get_fields_and_field_types"):
            yield from _fields(type(value), (*path, f"_{name}"))
        else:
            yield Field((*path, f"_{name}"), type_name, value)


def _parts(fields: list[Field]) -> Iterator[Part]:
    run: list[Field] = []
    for field in fields:
        if field.type_name in CODES:
            run.append(field)
            continue
        if run:
            yield Numbers(run)
        run = []
        yield _part(field)
    if run:
        yield Numbers(run)


def _part(field: Field) -> Part:
    if "," in field.type_name or "<=" in field.type_name or "wstring" in field.type_name:
        raise Unusual
    if isinstance(field.default, array):
        return Sequence(field)
    if hasattr(field.default, "dtype"):
        return Array(field)
    if field.type_name == "string":
        return Text(field)
    if field.type_name == "sequence<string>":
        return Texts(field)
    raise Unusual


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
    """All slots are set in one go, without a turn of the interpreter for each."""
    tree = _Tree(kind)
    readers = tuple(part.read for part in parts)
    targets = tree.slots + [tree.slot(path) for part in parts for path in part.targets]
    owners = _items([owner for owner, _ in targets])
    names = [name for _, name in targets]
    kinds, fixed = tree.kinds, tree.fixed

    def decode(data: bytes) -> Any:
        if data[:START] != _HEADER:
            raise Unusual
        made = list(map(object.__new__, kinds))
        values = made[1:] + fixed
        at = 0
        for read in readers:
            at = read(data, at, values)
        deque(map(setattr, owners(made), names, values), maxlen=0)
        return made[0]

    return decode


def _items(places: list[int]) -> Callable[[list[Any]], tuple[Any, ...]]:
    if len(places) == 1:
        return tuple  # there is one message only
    get: Callable[[list[Any]], tuple[Any, ...]] = itemgetter(*places)
    return get


class _Tree:
    """A message and those within it, the outermost first.

    Attributes:
        kinds: their classes.
        fixed: what is always the same in them: whether their setters check.
        slots: for all but the first, and for all of ``fixed``: which message they belong into, and
            by which name.
    """

    def __init__(self, kind: type) -> None:
        self.kinds: list[Any] = []
        self.fixed: list[Any] = []
        self._places: dict[tuple[str, ...], int] = {}
        inner: list[tuple[int, str]] = []
        switches: list[tuple[int, str]] = []
        self._add(kind, (), inner, switches)
        self.slots = inner + switches

    def slot(self, path: tuple[str, ...]) -> tuple[int, str]:
        """Which of the messages a slot belongs to, and its name."""
        return self._places[path[:-1]], path[-1]

    def _add(
        self,
        kind: Any,
        path: tuple[str, ...],
        inner: list[tuple[int, str]],
        switches: list[tuple[int, str]],
    ) -> None:
        place = self._places[path] = len(self.kinds)
        self.kinds.append(kind)
        default, types = kind(), kind.get_fields_and_field_types()
        for slot in kind.__slots__:
            value = getattr(default, slot)
            if slot[1:] not in types:
                switches.append((place, slot))
                self.fixed.append(value)
            elif hasattr(value, "get_fields_and_field_types"):
                inner.append((place, slot))
                self._add(type(value), (*path, slot), inner, switches)
