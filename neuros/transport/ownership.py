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

_SEVERAL = (tuple, list)  # as a union it would be made anew at each use


def _count(box: Sequence[Any], place: int) -> int:
    """How many references there are to an item, those that counting needs included."""
    return sys.getrefcount(getitem(box, place))


def _counts(found: tuple[Any, ...], number: int) -> tuple[int, ...]:
    """The same for the first ones of the parts of a message, which have been got from it."""
    return tuple(map(sys.getrefcount, found[:number]))


def _measured() -> tuple[int, int]:
    """What both say of an object with one holder; 0, which never occurs, if they do not count."""
    box, get = [[0], [0]], attrgetter("free", "held", "other")
    message = SimpleNamespace(free=[0], held=[0], other=[0])
    keeper = [box[1], message.held]
    has_free_threads = not getattr(sys, "_is_gil_enabled", lambda: True)()
    in_box, in_message = _count(box, 0), _counts(get(message), 2)[0]
    is_counting = _count(box, 1) == in_box + 1 and _counts(get(message), 2)[1] == in_message + 1
    del keeper[:]
    is_exact = is_counting and _counts(get(message), 2) == (in_message, in_message)
    return (in_box, in_message) if is_exact and not has_free_threads else (0, 0)


_ALONE_IN_BOX, _ALONE_IN_MESSAGE = _measured()


def unheld(box: Sequence[Any]) -> list[Any]:
    """Which packets of a hook's result, the only element of ``box``, have no other holder.

    The result is a packet, or a tuple or list of packets; ``box`` must be all that refers to it.
    """
    if _count(box, 0) != _ALONE_IN_BOX:
        return []
    if not isinstance(box[0], _SEVERAL):
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
    """A part of a message: where it is, and what it must be (``None``: anything of its class).

    A ``switch`` is no field but the message's own, and must have this one value.
    """

    path: str
    kind: type
    is_changeable: bool
    check: Check | None = None
    switch: object = None


def _message(kind: Any) -> Check:
    # Changeable ones first, switches last: so each sort is a slice of what is got at once.
    parts = sorted(_parts(kind, ""), key=lambda p: (p.switch is not None, not p.is_changeable))
    get = _getter([part.path for part in parts])
    kinds = tuple(part.kind for part in parts)
    changeable = sum(part.is_changeable for part in parts)
    alone = (_ALONE_IN_MESSAGE,) * changeable
    positions = tuple(part.switch for part in parts if part.switch is not None)
    fields = len(parts) - len(positions)
    checks = tuple((place, part.check) for place, part in enumerate(parts) if part.check)

    def is_unshared(message: Any) -> bool:
        try:
            found = get(message)
        except AttributeError:  # a part is of another class
            return False
        if _counts(found, changeable) != alone:
            return False
        if tuple(map(type, found)) != kinds or found[fields:] != positions:
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
            yield _Part(path, value_kind, is_changeable=True)
            yield from _parts(value_kind, f"{path}.")
        elif type_name is None:  # a switch of the message's own
            yield _Part(path, value_kind, is_changeable=False, switch=value)
        else:
            is_changeable = not isinstance(value, float | int | str)
            yield _Part(path, value_kind, is_changeable, _field(type_name, value))


def _getter(paths: Sequence[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Gets many parts at once, which is what makes this cheaper than a copy."""
    if len(paths) > 1:
        return attrgetter(*paths)
    # With one path attrgetter returns the value, not a tuple with it.
    return lambda message: tuple(attrgetter(path)(message) for path in paths)


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
        return INTEGERS[type_name].__contains__
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
