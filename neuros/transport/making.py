"""New messages with default values, made like the first one of their class.

The constructor of a message imports the classes of its parts and looks at all its arguments each
time. A message without arguments always comes out the same, so what its parts are is found once.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import cache
from typing import Any, TypeAlias

from neuros.transport.messages import message_class

Make: TypeAlias = Callable[[], Any]

_SHARED = (bool, int, float, str, bytes, type(None))
"""Values that nobody can change."""


def make_packet(type_name: str) -> Any:
    """A new message of a type in ROS notation, as its class without arguments would make it."""
    return _maker(message_class(type_name))()


@cache
def _maker(kind: Any) -> Make:
    default = kind()
    values = [(slot, getattr(default, slot)) for slot in kind.__slots__]
    shared = tuple((slot, value) for slot, value in values if isinstance(value, _SHARED))
    own = tuple((slot, _again(value)) for slot, value in values if not isinstance(value, _SHARED))
    if any(make is None for _, make in own):
        made: Make = kind
        return made

    def make() -> Any:
        message: Any = object.__new__(kind)
        for slot, value in shared:
            setattr(message, slot, value)
        for slot, make_part in own:
            setattr(message, slot, make_part())  # type: ignore[misc]
        return message

    return make


def _again(value: Any) -> Make | None:
    """What makes a default value again, ``None`` for a sort that is not known here."""
    if hasattr(value, "get_fields_and_field_types"):
        kind: Any = type(value)
        return _maker(kind)
    if isinstance(value, array):
        return value.__copy__
    if hasattr(value, "dtype"):
        copy: Make = value.copy
        return copy
    return list if value == [] else None
