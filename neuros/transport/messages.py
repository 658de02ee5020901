"""Packets, ROS messages or NumPy arrays: their kinds by type name, new ones, copies, bytes.

A copy is equal to what a receiver of the packet's bytes gets.

The plain way is to serialise and to deserialise. For a small message that takes long (an ``Imu``
30 µs), mostly for looking up Python classes from C. A message that has been checked
(:mod:`neuros.transport.values`) holds what its receivers see already, so its copy shares
its values, except those that can be changed. A new message is a copy of the first one of its class,
so that its constructor runs once.
"""

from __future__ import annotations

import importlib.util
import re
import warnings
from array import array
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy
from rclpy.type_support import check_for_type_support

from neuros.errors import EnvironmentFault, WrongValue
from neuros.project.message_types import ArrayType, array_type
from neuros.project.model import Port
from neuros.transport.codecs import message_codec
from neuros.transport.imports_when_used import imports_when_used
from neuros.transport.schema import Field, Shape, Sort, schema
from neuros.transport.setters import guard_setters
from neuros.transport.values import checker

_TYPE_NAME = re.compile(r"([A-Za-z][A-Za-z0-9_]*)/msg/([A-Za-z][A-Za-z0-9_]*)")


@cache
def packet_kind(type_name: str) -> Any:
    """What packets of a type are: a message class, or an :class:`ArrayType`.

    Raises:
        EnvironmentFault: as :func:`message_class`.
    """
    kind = message_class(type_name)
    return array_type(type_name) or kind


def kind_of(packet: Any) -> Any:
    """What a packet is, as :func:`packet_kind` has it."""
    kind = type(packet)
    if hasattr(kind, "get_fields_and_field_types"):  # a message, which needs no NumPy
        return kind
    return _kind_of_array(packet.dtype, packet.shape)


@cache
def _kind_of_array(dtype: Any, shape: tuple[int, ...]) -> ArrayType:
    return ArrayType(dtype.name, shape)


@cache
def message_class(type_name: str) -> type:
    """The class of a message type in ROS notation, ``"std_msgs/msg/String"``.

    For the type of arrays it is that of the messages which ROS sees.

    Raises:
        EnvironmentFault: if its package is not installed or has no such message.
    """
    if (array := array_type(type_name)) is not None:
        return message_class(array.message)
    named = _TYPE_NAME.fullmatch(type_name)
    if named is None:
        raise EnvironmentFault(f"{type_name!r} is not a message type: write package/msg/Name")
    package, name = named.groups()
    try:
        # Raise ``ImportError`` for what is no message package, without importing it. Bags, and
        # other programs in the ROS domain, name types, too.
        spec = importlib.util.find_spec(package)
        folders = (spec and spec.submodule_search_locations) or ()
        if not any(Path(folder, "msg").is_dir() for folder in folders):
            raise ImportError(f"no message package named '{package}'")
        with imports_when_used():
            found = getattr(importlib.import_module(f"{package}.msg"), name)
        with warnings.catch_warnings():
            # What ROS loads for its first message uses a module that Python calls deprecated.
            warnings.simplefilter("ignore", DeprecationWarning)
            check_for_type_support(found)
        guard_setters(found)
    except (ImportError, AttributeError, ValueError) as error:
        raise EnvironmentFault(
            f"message type {type_name} cannot be imported here ({error}): is its package"
            " installed in this node's container?"
        ) from error
    return cast(type, found)


def checked(port: Port, packet: Any) -> Any:
    """A packet that a program outside the nodes sends to an input, with the values that arrive.

    Raises:
        TypeError: if it is of another type.
        ValueError: if it holds a value that no node may send, or is an array of another type.
    """
    kind = packet_kind(port.type)
    if not isinstance(packet, numpy.ndarray if isinstance(kind, ArrayType) else kind):
        hint = f": make an array of it, numpy.asarray(values, '{kind.dtype}')" if port.array else ""
        raise TypeError(f"input '{port.name}' takes {port.type}, not {packet!r}{hint}")
    try:
        return checker(kind)(packet)
    except WrongValue as error:
        raise ValueError(f"packet for input '{port.name}': {error}") from None


Copy: TypeAlias = Callable[[Any], Any]


def make_packet(type_name: str) -> Any:
    """A new packet of a type: a message as its class without arguments makes it, or zeros."""
    return factory_of(type_name)()


@cache
def factory_of(type_name: str) -> Callable[[], Any]:
    """The function that makes packets of a type."""
    factory: Callable[[], Any] = _factory(packet_kind(type_name))
    return factory


@cache
def copier_of(type_name: str) -> Copy:
    """The function that copies packets of a type."""
    copier: Copy = _copier(packet_kind(type_name))
    return copier


def encode_packet(packet: Any) -> bytes:
    return message_codec(kind_of(packet)).encode(packet)


class RosPackets:
    """What NeuROS does with packets (:class:`neuros.ports.Packets`)."""

    maker = staticmethod(factory_of)
    encode = staticmethod(encode_packet)
    copier = staticmethod(copier_of)

    @staticmethod
    def packet_class(type_name: str) -> type:
        kind = packet_kind(type_name)
        return numpy.ndarray if isinstance(kind, ArrayType) else cast(type, kind)

    def checker(self, type_name: str, *, for_jpeg: bool = False) -> Copy:
        if for_jpeg:
            from neuros.transport.jpeg import jpeg_checker

            return jpeg_checker()
        return checker(packet_kind(type_name))

    def decode(self, type_name: str, data: bytes) -> Any:
        return message_codec(packet_kind(type_name)).decode(data)


def copy_packet(packet: Any) -> Any:
    """A packet that shares nothing with ``packet``, which has been checked."""
    return _copier(kind_of(packet))(packet)


@cache
def _factory(kind: Any) -> Callable[[], Any]:
    if isinstance(kind, ArrayType):
        return partial(numpy.zeros, kind.shape, kind.dtype)
    default = kind()
    values = [(slot, getattr(default, slot)) for slot in kind.__slots__]
    changeable = {
        field.slot: _factory_of(field) for field in schema(kind).fields if _can_change(field)
    }
    shared = tuple((slot, value) for slot, value in values if slot not in changeable)
    made = tuple((slot, changeable[slot](value)) for slot, value in values if slot in changeable)

    def make() -> Any:
        message: Any = object.__new__(kind)
        for slot, value in shared:
            setattr(message, slot, value)
        for slot, make_value in made:
            setattr(message, slot, make_value())
        return message

    return make


def _factory_of(field: Field) -> Callable[[Any], Callable[[], Any]]:
    """A function from a default value to the factory of its copies."""
    if field.is_message:
        return lambda _: _factory(field.type.message)
    copy = _copier_of(field)
    return lambda value: partial(copy, value)


def _copy_array(packet: Any) -> Any:
    """A copy of an array, row by row, for its receivers: read-only."""
    twin = packet.copy()
    twin.setflags(write=False)  # in a third of the time of flags.writeable
    return twin


@cache
def _copier(kind: Any) -> Copy:
    if isinstance(kind, ArrayType):
        return _copy_array
    layout = schema(kind)
    changeable = tuple((f.slot, _copier_of(f)) for f in layout.fields if _can_change(f))
    names = tuple(f.slot for f in layout.fields if not _can_change(f))
    switches = tuple((slot, value) for owner, slot, value in layout.switches if not owner)

    def copy(message: Any) -> Any:
        twin: Any = object.__new__(kind)
        for slot in names:
            setattr(twin, slot, getattr(message, slot))
        for slot, value in switches:
            setattr(twin, slot, value)
        for slot, copy_value in changeable:
            setattr(twin, slot, copy_value(getattr(message, slot)))
        return twin

    return copy


def _can_change(field: Field) -> bool:
    return field.shape is not Shape.SINGLE or field.type.sort is Sort.MESSAGE


def _copier_of(field: Field) -> Copy:
    if field.is_message:
        return _copier(field.type.message)
    if field.shape is Shape.ARRAY:
        return numpy.ndarray.copy
    if field.shape is Shape.BUFFER:
        return array.__copy__
    if field.type.sort is not Sort.MESSAGE:
        return list.copy
    copy = _copier(field.type.message)
    return lambda messages: list(map(copy, messages))
