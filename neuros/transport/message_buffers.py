"""Buffers of a message, its sequences of numbers: found, left out, and put back as lazy ones.

Pixels, points and scans are fields of the kind ``uint8[]`` or ``float32[]``: sequences without a
bound, which Python holds as ``array.array``. Which fields of a message type those are is found out
once, from its class: its own, and those of messages within it (not of *sequences* of messages).
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from neuros.transport.packet_segment import StoredBuffer
from neuros.transport.schema import Shape, getter, schema


class MessageBuffers:
    """The buffers of a message class: found in a message, left out, and put back.

    Attributes:
        fields: the names that lead to each, ``"image.data"``, in the order of the message.
        typecodes: what each holds, as ``array`` calls it.
    """

    def __init__(self, kind: type) -> None:
        self._layout = schema(kind)
        self._leaves = [
            place
            for place, leaf in enumerate(self._layout.leaves)
            if leaf.field.shape is Shape.BUFFER and leaf.field.bound is None
        ]
        found = [self._layout.leaves[place] for place in self._leaves]
        self._paths = [leaf.path for leaf in found]
        self.fields = tuple(".".join(slot[1:] for slot in path) for path in self._paths)
        self.typecodes = tuple(leaf.field.type.code for leaf in found)
        self._kind = kind
        self._get = getter(self._paths)
        holders: dict[tuple[str, ...], tuple[str, ...]] = {}
        for *path, slot in self._paths:
            holders[tuple(path)] = (*holders.get(tuple(path), ()), slot)
        self._holders = holders

    def of(self, packet: Any) -> Sequence[array[Any]] | None:
        """The buffers of a message; ``None`` if one is not the array that ROS makes of it."""
        if not isinstance(packet, self._kind):
            return None
        try:
            values = self._get(packet)
        except AttributeError:  # a plugin put something else where a message belongs
            return None
        found: list[array[Any]] = []
        for value, typecode in zip(values, self.typecodes, strict=True):
            buffer = value.fetch() if type(value) is StoredBuffer else value
            if type(buffer) is not array or buffer.typecode != typecode:
                return None
            found.append(buffer)
        return found

    def views(self, packet: Any) -> Sequence[memoryview]:
        """The bytes of the buffers of a message, where they lie; of what is no buffer, none."""
        try:
            values = self._get(packet)
        except AttributeError:
            return ()
        views: list[memoryview] = []
        for value in values:
            if isinstance(value, StoredBuffer):
                views.append(value.view())
            elif isinstance(value, array):
                views.append(memoryview(value).cast("B"))
        return views

    def leave_out(self, packet: Any) -> Any:
        """A message like this one with empty buffers, which shares all else with it."""
        values = list(self._layout.values(packet))
        for place, typecode in zip(self._leaves, self.typecodes, strict=True):
            values[place] = array(typecode)
        return self._layout.make(values)

    def put_back(self, packet: Any, buffers: Sequence[StoredBuffer]) -> None:
        """Give a message these buffers; they are copied when one of them is asked for."""
        for path, buffer in zip(self._paths, buffers, strict=True):
            setattr(_follow(packet, path[:-1]), path[-1], buffer)
        for path, slots in self._holders.items():
            _make_lazy(_follow(packet, path), slots)


@cache
def message_buffers(kind: type) -> MessageBuffers | None:
    """The buffers of a message class, ``None`` if it has none."""
    buffers = MessageBuffers(kind)
    return buffers if buffers.fields else None


def _follow(message: Any, path: Sequence[str]) -> Any:
    for slot in path:
        message = getattr(message, slot)
    return message


def _make_lazy(message: Any, slots: tuple[str, ...]) -> None:
    """Turn a message into a lazy one: it copies its stored buffers when a plugin asks for one.

    A message that is only passed on, or of which a plugin reads the header alone, is never copied.
    Until then its class is one derived from that of ROS, with a property for each buffer. The first
    access to any of them puts all into place and gives the message the class of ROS: the class of
    an object may change where the layout is equal.
    """
    kind: Any = type(message)
    message.__class__ = _lazy_class(kind, slots)


@cache
def _lazy_class(kind: Any, slots: tuple[str, ...]) -> type:
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
    lazy: Any = type(kind)(kind.__name__, (kind,), content)
    lazy.__slots__ = kind.__slots__  # what people list the fields of a message by
    assert isinstance(lazy, type)
    return lazy


def _property(name: str, complete: Callable[[Any], None]) -> property:
    def get(message: Any) -> Any:
        complete(message)
        return getattr(message, name)

    def put(message: Any, value: Any) -> None:
        complete(message)
        setattr(message, name, value)

    return property(get, put)
