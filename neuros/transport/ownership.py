"""Whether a packet may be handed to another node as it is, because nobody else holds any of it.

CPython counts references, and whoever could change a packet later holds one: to the packet, to a
message, list or array in it, or, for a view of a buffer, to that buffer. So a packet is unshared if
it and each changeable part of it have exactly the one reference of what contains them. A part that
can be reached without being counted (a weak reference, memory that an array does not own) makes it
shared. As a copy comes out with the fields that a receiver in another process would see, a
packet with a value that ROS would convert (:mod:`neuros.transport.copying`) is not handed over.

References are read through functions in C alone, which return new references in every release of
Python; from local variables 3.14 borrows some without counting. The count of an object with one
holder is measured at import. Where counts say less (free threads), nothing counts as unshared.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from operator import attrgetter, getitem
from types import SimpleNamespace
from typing import Any, TypeAlias
from weakref import getweakrefcount

from neuros.transport.copying import INTEGERS, Unusual, is_plain_text
from neuros.transport.messages import message_class

Check: TypeAlias = Callable[[Any], bool]


def _count(box: Sequence[Any], place: int) -> int:
    """How many references there are to an item, those that counting needs included."""
    return sys.getrefcount(getitem(box, place))


def _counts(get: Callable[[Any], tuple[Any, ...]], message: Any) -> tuple[int, ...]:
    """The same for parts of a message."""
    return tuple(map(sys.getrefcount, get(message)))


def _measured() -> tuple[int, int]:
    """What both say of an object with one holder; 0, which never occurs, if they do not count."""
    box, get = [[0], [0]], attrgetter("free", "held")
    message = SimpleNamespace(free=[0], held=[0])
    keeper = [box[1], message.held]
    has_free_threads = not getattr(sys, "_is_gil_enabled", lambda: True)()
    in_box, in_message = _count(box, 0), _counts(get, message)[0]
    is_counting = _count(box, 1) == in_box + 1 and _counts(get, message)[1] == in_message + 1
    del keeper[:]
    is_exact = is_counting and _counts(get, message) == (in_message, in_message)
    return (in_box, in_message) if is_exact and not has_free_threads else (0, 0)


_ALONE_IN_BOX, _ALONE_IN_MESSAGE = _measured()


def unheld(box: Sequence[Any]) -> list[Any]:
    """Which packets of a hook's result, the only element of ``box``, have no other holder.

    The result is a packet, or a tuple or list of packets; ``box`` must be all that refers to it.
    """
    if _count(box, 0) != _ALONE_IN_BOX:
        return []
    if not isinstance(box[0], tuple | list):
        return [box[0]]
    result = box[0]
    return [
        getitem(result, place)
        for place in range(len(result))
        if _count(result, place) == _ALONE_IN_BOX
    ]


def is_unshared_inside(packet: Any) -> bool:
    """Whether nobody holds a part of a packet, and all of it is as ROS would deliver it."""
    kind: Any = type(packet)
    check = _check_of(kind)
    return check is not None and check(packet)


@cache
def _check_of(kind: type) -> Check | None:
    """What checks messages of a class, ``None`` where they are never handed over."""
    try:
        return _message(kind)
    except Unusual:
        return None


@dataclass(frozen=True)
class _Part:
    """A part of a message: where it is, and what it must be (``None``: anything of its class)."""

    path: str
    kind: type
    is_changeable: bool
    check: Check | None


def _message(kind: Any) -> Check:
    parts = tuple(_parts(kind, ""))
    changeable = _Getter([part.path for part in parts if part.is_changeable])
    values = _Getter([part.path for part in parts])
    kinds = tuple(part.kind for part in parts)
    checks = tuple((place, part.check) for place, part in enumerate(parts) if part.check)
    alone = (_ALONE_IN_MESSAGE,) * len(changeable.paths)

    def is_unshared(message: Any) -> bool:
        try:
            if _counts(changeable.get, message) != alone:
                return False
            found = values.get(message)
        except AttributeError:  # a part is of another class
            return False
        if tuple(map(type, found)) != kinds:
            return False
        for place, check in checks:  # noqa: SIM110, a generator takes thrice as long
            if not check(found[place]):
                return False
        return True

    return is_unshared


def _parts(kind: Any, prefix: str) -> Iterator[_Part]:
    """All parts of messages of a class, those of the messages in it included."""
    if kind.__weakrefoffset__ or kind.__dictoffset__:
        raise Unusual
    types, default = kind.get_fields_and_field_types(), kind()
    for slot in kind.__slots__:
        value: Any = getattr(default, slot)
        path, value_kind = prefix + slot, type(value)
        type_name = types.get(slot[1:])
        if hasattr(value, "get_fields_and_field_types"):
            yield _Part(path, value_kind, True, None)
            yield from _parts(value_kind, f"{path}.")
        elif type_name is None:  # a switch of the message's own
            yield _Part(path, value_kind, False, _is(value))
        else:
            is_changeable = not isinstance(value, float | int | str)
            yield _Part(path, value_kind, is_changeable, _field(type_name, value))


class _Getter:
    """Gets many parts at once, which is what makes this cheaper than a copy."""

    def __init__(self, paths: Sequence[str]) -> None:
        self.paths = paths
        # With one path attrgetter returns the value, not a tuple with it.
        self.get: Callable[[Any], tuple[Any, ...]] = (
            attrgetter(*paths)
            if len(paths) > 1
            else lambda message: tuple(attrgetter(path)(message) for path in paths)
        )


def _field(type_name: str, default: Any) -> Check | None:
    """For values of the type of ``default``; ``None`` where any such value will do."""
    if "," in type_name:  # no more than so many: ROS sees to that
        raise Unusual
    if isinstance(default, array):
        return _numbers_in_sequence(default.typecode)
    if hasattr(default, "dtype"):
        return _numbers_in_array(default)
    if type_name.startswith("sequence<"):
        return _items(type_name[len("sequence<") : -1])
    return _single(type_name)


def _single(type_name: str) -> Check | None:
    if type_name in ("double", "boolean"):
        return None
    if type_name in INTEGERS:
        allowed = INTEGERS[type_name]
        return lambda value: value in allowed
    if type_name == "string":
        return is_plain_text
    package, _, name = type_name.partition("/")
    if not name.isidentifier():
        raise Unusual
    return _message(message_class(f"{package}/msg/{name}"))


def _items(type_name: str) -> Check:
    """For a list of messages, texts or truth values."""
    check = _single(type_name)
    package, _, name = type_name.partition("/")
    is_message = bool(name)
    kind = message_class(f"{package}/msg/{name}") if is_message else _KINDS.get(type_name)

    def are_unshared(items: list[Any]) -> bool:
        return all(
            type(getitem(items, place)) is kind
            and (not is_message or _count(items, place) == _ALONE_IN_BOX)
            and (check is None or check(getitem(items, place)))
            for place in range(len(items))
        )

    return are_unshared


_KINDS = {"string": str, "boolean": bool}
"""Of numbers ROS makes arrays."""


def _numbers_in_sequence(code: str) -> Check:
    return lambda value: value.typecode == code and not getweakrefcount(value)


def _numbers_in_array(default: Any) -> Check:
    numbers, shape = default.dtype, default.shape

    def is_unshared(value: Any) -> bool:
        flags = value.flags
        return bool(
            value.dtype == numbers
            and value.shape == shape
            and flags.owndata
            and flags.carray
            and not getweakrefcount(value)
        )

    return is_unshared


def _is(default: Any) -> Check:
    return lambda value: value is default
