"""The large part of a message: its sequences of numbers, apart from the rest.

Pixels, points and scans are fields of the kind ``uint8[]`` or ``float32[]``: sequences without a
bound, which Python holds as ``array.array``. Which fields of a message type those are is found out
once, from its class: its own, and those of messages within it (not of *sequences* of messages).
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from functools import cache
from typing import Any

from neuros.transport.late_message import make_late
from neuros.transport.packet_segment import StoredBuffer
from neuros.transport.schema import Shape, getter, schema


class MessageBuffers:
    """The buffers of a message class: found in a message, left out, and put back.

    Attributes:
        fields: the names that lead to each, ``"image.data"``, in the order of the message.
        typecodes: what each holds, as ``array`` calls it.
    """

    def __init__(self, kind: type) -> None:
        found = [
            leaf
            for leaf in schema(kind).leaves
            if leaf.field.shape is Shape.BUFFER and leaf.field.bound is None
        ]
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
        twin = _shallow(packet, self._kind)
        for path, typecode in zip(self._paths, self.typecodes, strict=True):
            holder = twin
            for slot in path[:-1]:
                inner = getattr(holder, slot)
                inner = _shallow(inner, type(inner))
                setattr(holder, slot, inner)
                holder = inner
            setattr(holder, path[-1], array(typecode))
        return twin

    def put_back(self, packet: Any, buffers: Sequence[StoredBuffer]) -> None:
        """Give a message these buffers; they are copied when one of them is asked for."""
        for path, buffer in zip(self._paths, buffers, strict=True):
            setattr(_follow(packet, path[:-1]), path[-1], buffer)
        for path, slots in self._holders.items():
            make_late(_follow(packet, path), slots)


@cache
def message_buffers(kind: type) -> MessageBuffers | None:
    """The buffers of a message class, ``None`` if it has none."""
    buffers = MessageBuffers(kind)
    return buffers if buffers.fields else None


def _follow(message: Any, path: Sequence[str]) -> Any:
    for slot in path:
        message = getattr(message, slot)
    return message


def _shallow(message: Any, kind: Any) -> Any:
    twin: Any = object.__new__(kind)
    for slot in kind.__slots__:
        setattr(twin, slot, getattr(message, slot))
    return twin
