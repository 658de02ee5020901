"""Messages whose buffers are copied out of shared memory when somebody looks at them.

A packet that is only passed by, or of which only the header is read, need not be copied at all. So
a received message is at first of a class of its own, derived from the one of ROS, with a property
for each buffer. The first access to any of them puts all into place and turns the message into
what it says it is: the class of an object may change where the layout is the same.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from neuros.transport.packet_segment import StoredBuffer


def make_late(message: Any, slots: tuple[str, ...]) -> None:
    """Have the stored buffers in these slots of a message fetched when one is asked for."""
    kind: Any = type(message)
    message.__class__ = _late_kind(kind, slots)


@cache
def _late_kind(kind: Any, slots: tuple[str, ...]) -> type:
    def complete(message: Any) -> None:
        for slot in slots:
            value = getattr(message, slot, None)  # none yet while it is being created
            if type(value) is StoredBuffer:
                setattr(message, slot, value.fetch())
        message.__class__ = kind

    def compare(message: Any, other: object) -> bool:
        complete(message)
        return bool(message == other)

    def reduce(message: Any, protocol: Any) -> Any:
        complete(message)
        return message.__reduce_ex__(protocol)

    content = {
        "__slots__": (),
        "__module__": kind.__module__,
        "__qualname__": kind.__qualname__,
        "__doc__": kind.__doc__,
        "__eq__": compare,
        "__hash__": None,
        "__reduce_ex__": reduce,
        **{slot[1:]: _property(slot[1:], complete) for slot in slots},
    }
    late: Any = type(kind)(kind.__name__, (kind,), content)
    late.__slots__ = kind.__slots__  # what people list the fields of a message by
    assert isinstance(late, type)
    return late


def _property(name: str, complete: Callable[[Any], None]) -> property:
    def get(message: Any) -> Any:
        complete(message)
        return getattr(message, name)

    def put(message: Any, value: Any) -> None:
        complete(message)
        setattr(message, name, value)

    return property(get, put)
