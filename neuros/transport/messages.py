"""ROS message classes by their type name, and messages to bytes and back by rclpy."""

from __future__ import annotations

import importlib
import struct
import warnings
from functools import cache
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message
from rclpy.type_support import check_for_type_support

from neuros.errors import EnvironmentFault, ProtocolError

# CDR: two bytes for the encoding (1: little-endian), two unused ones, and the number
# (OMG DDSI-RTPS 2.5, 10.2).
_POSITION = struct.Struct("<4sQ")
_BIG_ENDIAN_POSITION = struct.Struct(">4sQ")
_LITTLE_ENDIAN = b"\0\1\0\0"


@cache
def message_class(type_name: str) -> type:
    """The class of a message type in ROS notation, ``"std_msgs/msg/String"``.

    Raises:
        EnvironmentFault: if its package is not installed or has no such message.
    """
    package, _, name = type_name.replace("/", ".").rpartition(".")
    try:
        found = getattr(importlib.import_module(package), name)
    except (ImportError, AttributeError) as error:
        raise EnvironmentFault(
            f"message type {type_name} cannot be imported here ({error}): is its package"
            " installed in this node's container?"
        ) from error
    assert isinstance(found, type)
    with warnings.catch_warnings():
        # What ROS loads for its first message uses a module that Python calls deprecated.
        warnings.simplefilter("ignore", DeprecationWarning)
        check_for_type_support(found)
    return found


def encode(packet: Any) -> tuple[type, bytes]:
    """The class of a packet, and its bytes as DDS would carry them."""
    return type(packet), serialize_message(packet)


def decode(parcel: tuple[type, bytes]) -> Any:
    """The packet in a parcel; it shares nothing with the one that was sent."""
    kind, data = parcel
    return deserialize_message(data, kind)


def encode_position(position: int) -> bytes:
    """A ``std_msgs/msg/UInt64`` as DDS carries it, without a message object in between."""
    return _POSITION.pack(_LITTLE_ENDIAN, position)


def decode_position(data: bytes) -> int:
    """The number in a ``std_msgs/msg/UInt64``, from a sender of either byte order.

    Raises:
        ProtocolError: if it is none.
    """
    try:
        kind = _POSITION if data[1] else _BIG_ENDIAN_POSITION
        position: int = kind.unpack(data)[1]
    except (IndexError, struct.error) as error:
        raise ProtocolError(f"{len(data)} bytes are no acknowledgement") from error
    return position
