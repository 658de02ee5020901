"""ROS message classes by their type name, and messages to bytes and back by rclpy."""

from __future__ import annotations

import importlib
import warnings
from functools import cache
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message
from rclpy.type_support import check_for_type_support

from neuros.errors import EnvironmentFault, WrongValue
from neuros.project.model import Port
from neuros.transport.values import checker


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


def checked(port: Port, packet: Any) -> Any:
    """A packet that a program outside the nodes sends to an input, with the values that arrive.

    Raises:
        TypeError: if it is of another type.
        ValueError: if it holds a value that no node may send.
    """
    kind = message_class(port.type)
    if not isinstance(packet, kind):
        raise TypeError(f"input '{port.name}' takes {port.type}, not {packet!r}")
    try:
        return checker(kind)(packet)
    except WrongValue as error:
        raise ValueError(f"packet for input '{port.name}': {error}") from None


def encode(packet: Any) -> tuple[type, bytes]:
    """The class of a packet, and its bytes as DDS would carry them."""
    return type(packet), serialize_message(packet)


def decode(parcel: tuple[type, bytes]) -> Any:
    """The packet in a parcel; it shares nothing with the one that was sent."""
    kind, data = parcel
    return deserialize_message(data, kind)
