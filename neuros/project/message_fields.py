"""Paths of fields, such as ``angular_velocity.z`` or ``ranges[0]``: what they lead to in a message.

The fields of an installed message come from its class. Those of a message package of the project,
which need not be built yet, come from its ``.msg`` file, which rosidl's parser reads.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from neuros.project.message_types import MessageField, MessagePackages, imported
from neuros.project.suggest import did_you_mean, listed

_PATH = re.compile(r"[A-Za-z_]\w*(\[\d+\])*(\.[A-Za-z_]\w*(\[\d+\])*)*", re.ASCII)
_STEP = re.compile(r"(\w+)|\[(\d+)\]", re.ASCII)
_OF_CLASS = re.compile(r"(sequence<)?([\w/]+)(?:<\d+>)?(?:, \d+)?>?(\[\d+\])?", re.ASCII)


def fields_of(type_name: str, packages: MessagePackages) -> Mapping[str, MessageField] | None:
    """The fields of a message type by name; ``None`` where its definition is not on this machine.

    Args:
        type_name: as ``sensor_msgs/msg/Imu``.
        packages: those that are built for the project.
    """
    package, _, name = type_name.split("/")
    own = packages.fields(package, name)
    if own is not None:
        return own
    message = imported(package, name)
    if message is None:
        return None
    types: Mapping[str, str] = message.get_fields_and_field_types()
    return {key: _of_class(text) for key, text in types.items()}


def _of_class(text: str) -> MessageField:
    found = _OF_CLASS.fullmatch(text)
    assert found is not None, text
    package, _, name = found[2].rpartition("/")
    written = f"{package}/msg/{name}" if package else name
    return MessageField(written, is_array=bool(found[1] or found[3]))


def misfit(
    type_name: str, path: str, packages: MessagePackages, *, wants_array: bool
) -> tuple[str, str] | None:
    """What is wrong with the path of a field, and a hint; ``None`` if nothing is, or it is unknown.

    Args:
        type_name: of the message, as ``sensor_msgs/msg/Imu``.
        path: as ``angular_velocity.z`` or ``ranges[0]``.
        wants_array: whether it has to lead to an array of numbers; else it must be to one number.
    """
    if not _PATH.fullmatch(path):
        return f"'{path}' is not the path of a field", "write it as 'angular_velocity.z'"
    here, done = MessageField(type_name, is_array=False), ""
    for name, place in _STEP.findall(path):
        if place:
            if not here.is_array:
                return f"'{done}' of {type_name} is {here}, which has no elements", ""
            here, done = MessageField(here.type, is_array=False), f"{done}[{place}]"
            continue
        if not here.is_message:
            hint = f"name an element, as '{done}[0]'" if here.is_array else ""
            return f"'{done}' of {type_name} is {here}, which has no fields", hint
        fields = fields_of(here.type, packages)
        if fields is None:
            return None
        if name not in fields:
            has = f"it has {', '.join(repr(each) for each in fields)}" if fields else "it has none"
            meant = did_you_mean(name, fields)
            return f"{here.type} has no field '{name}'", f"{meant} {has}".strip()
        here, done = fields[name], f"{done}.{name}".lstrip(".")
    if here.has_numbers and here.is_array == wants_array:
        return None
    wanted = "an array of numbers" if wants_array else "a number"
    return f"'{path}' of {type_name} is {here}, not {wanted}", _instead(here, done, packages)


def _instead(here: MessageField, path: str, packages: MessagePackages) -> str:
    """How to go on from a path that ends too early."""
    if here.is_message:
        fields = fields_of(here.type, packages) or {}
        return f"name one of its fields: {listed(f'{path}.{each}' for each in fields)}"
    return f"name an element, as '{path}[0]'" if here.is_array else ""
