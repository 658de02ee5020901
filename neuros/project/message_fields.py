"""Paths of fields, such as ``angular_velocity.z`` or ``ranges[0]``: what they lead to in a message.

The fields of an installed message come from its class. Those of a message package of the project,
which need not be built yet, come from its ``.msg`` file.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from dataclasses import dataclass

from neuros.project.message_types import MessagePackages
from neuros.project.suggest import did_you_mean, listed

_PATH = re.compile(r"[A-Za-z_]\w*(\[\d+\])*(\.[A-Za-z_]\w*(\[\d+\])*)*", re.ASCII)
_STEP = re.compile(r"(\w+)|\[(\d+)\]", re.ASCII)
_DECLARED = re.compile(
    r"([\w/]+)(?:<=\d+)?(\[[^\]]*\])?[ \t]+(\w+)[ \t]*(?!\w|[ \t]*=)", re.ASCII | re.MULTILINE
)
_OF_CLASS = re.compile(r"(sequence<)?([\w/]+)(?:<\d+>)?(?:, \d+)?>?(\[\d+\])?", re.ASCII)
_TEXTS = ("string", "wstring", "byte", "octet", "wchar")
_PRIMITIVE = re.compile(r"u?int\d+|float\d*|double|bool|boolean|char|byte|octet|wchar|w?string")


@dataclass(frozen=True)
class MessageField:
    """A field, or an element of one.

    Attributes:
        type: of it, or of each of its elements: ``double``, ``geometry_msgs/msg/Vector3``.
        is_array: whether it has elements.
    """

    type: str
    is_array: bool

    @property
    def is_message(self) -> bool:
        """Whether it is a message, which has fields of its own."""
        return "/" in self.type and not self.is_array

    @property
    def has_numbers(self) -> bool:
        """Whether it is a number, or an array of numbers; true and false are numbers, too."""
        return "/" not in self.type and self.type not in _TEXTS

    def __str__(self) -> str:
        return f"an array of {self.type}" if self.is_array else self.type


def fields_of(type_name: str, packages: MessagePackages) -> Mapping[str, MessageField] | None:
    """The fields of a message type by name; ``None`` where its definition is not on this machine.

    Args:
        type_name: as ``sensor_msgs/msg/Imu``.
        packages: those that are built for the project.
    """
    package, _, name = type_name.split("/")
    file = packages.definition(package, name)
    if file is not None:
        try:
            text = file.read_text("utf-8")
        except (OSError, UnicodeError):
            return None  # the check of message packages says so
        lines = (line.partition("#")[0] for line in text.splitlines())
        found = filter(None, map(_DECLARED.match, lines))
        return {each[3]: _field(each[1], package, is_array=bool(each[2])) for each in found}
    try:
        message = getattr(importlib.import_module(f"{package}.msg"), name)
        types: Mapping[str, str] = message.get_fields_and_field_types()
    except Exception:  # no such package, or a broken one, which may raise anything
        return None
    return {key: _of_class(text, package) for key, text in types.items()}


def _of_class(text: str, package: str) -> MessageField:
    found = _OF_CLASS.fullmatch(text)
    assert found is not None, text
    return _field(found[2], package, is_array=bool(found[1] or found[3]))


def _field(written: str, package: str, *, is_array: bool) -> MessageField:
    if _PRIMITIVE.fullmatch(written):
        return MessageField(written, is_array)
    of, _, name = written.rpartition("/")
    return MessageField(f"{of or package}/msg/{name}", is_array)


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
