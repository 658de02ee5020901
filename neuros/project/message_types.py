"""Message types: their notation, and whether they exist on this machine.

Importing a message package costs tens of milliseconds. To see whether it has a message it is
enough to find the package and to look at the names that its ``msg`` package imports; only where
that list does not have the name (packages may build it in other ways) is it really imported.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from neuros.project.suggest import did_you_mean, listed

_NOTATION = re.compile(r"([A-Za-z]\w*)(?:\.msg\.|/msg/)([A-Za-z]\w*)", re.ASCII)
_TEXTS = ("string", "wstring", "byte", "octet", "wchar")
_IMPORTED = re.compile(r"^\s*from\s+\S+\s+import\s+(\w+)", re.MULTILINE)


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


class MessagePackages(Protocol):
    """Message packages that a project brings, or shares: they need not be built yet."""

    def messages(self, package: str) -> Collection[str] | None:
        """The names of its messages, ``None`` if there is no such package."""

    def installed(self, package: str) -> Path | None:
        """The folder that it is, or will be, built into, ``None`` if there is no such package."""

    def fields(self, package: str, name: str) -> Mapping[str, MessageField] | None:
        """The fields of a message, ``None`` if there is none, or its file is wrong."""


class NoPackages:
    """There are none (:class:`MessagePackages`)."""

    def messages(self, package: str) -> None:
        return None

    def installed(self, package: str) -> None:
        return None

    def fields(self, package: str, name: str) -> None:
        return None


NO_PACKAGES = NoPackages()


def normalised(text: str) -> str | None:
    """``std_msgs/msg/String`` for that or ``std_msgs.msg.String``, ``None`` for anything else."""
    match = _NOTATION.fullmatch(text)
    return f"{match[1]}/msg/{match[2]}" if match else None


def unknown_type(
    type_name: str, *, must_be_here: bool, packages: MessagePackages = NO_PACKAGES
) -> tuple[str, str] | None:
    """What is wrong with a normalised type, and a hint; ``None`` if nothing is, or it is not known.

    Args:
        must_be_here: whether it is wrong too if its package is not installed on this machine.
        packages: those that are built for the project.
    """
    package, _, name = type_name.split("/")
    folder = message_folder(package)
    own = packages.messages(package) if folder is None else None
    if own is not None:
        return None if name in own else _no_message(type_name, own)
    if folder is None:
        if not must_be_here:
            return None
        return (
            f"unknown message type '{type_name}': there is no message package '{package}' here",
            _similar_package(package)
            or f"a message of your own is workspace/{package}/msg/{name}.msg beside the project"
            f" file, with workspace/{package}/package.xml: docs/messages.md",
        )
    names = _IMPORTED.findall((folder / "__init__.py").read_text(encoding="utf-8"))
    if name in names or imported(package, name) is not None:
        return None
    return _no_message(type_name, names)


def _no_message(type_name: str, names: Collection[str]) -> tuple[str, str]:
    package, _, name = type_name.split("/")
    text = f"unknown message type '{type_name}': '{package}' has no message '{name}'"
    return text, did_you_mean(name, names)


def message_folder(package: str) -> Path | None:
    """The folder ``msg`` of an installed message package."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    for location in (spec.submodule_search_locations or ()) if spec else ():
        folder = Path(location, "msg")
        if (folder / "__init__.py").is_file():
            return folder
    return None


def imported(package: str, name: str) -> Any:
    """The class of an installed message, ``None`` if it cannot be used."""
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name, None)
    except Exception:  # a broken package raises anything
        return None


def _similar_package(package: str) -> str:
    """Whether another one is meant; nearly all end alike, which makes none of them similar."""
    ending = "_msgs" if package.endswith("_msgs") else ""
    names = {name.removesuffix(ending) for name in _installed_packages() if name.endswith(ending)}
    return did_you_mean(package.removesuffix(ending), names).replace("'?", f"{ending}'?")


def _installed_packages() -> set[str]:
    folders = [Path(entry) for entry in sys.path if Path(entry).is_dir()]
    return {
        package.name
        for folder in folders
        for package in folder.glob("*_*")
        if (package / "msg" / "__init__.py").is_file()
    }


# ---------------------------------------------------------------------- fields
#
# Paths of fields, such as ``angular_velocity.z`` or ``ranges[0]``: what they lead to in a message.
#
# The fields of an installed message come from its class. Those of a message package of the
# project, which need not be built yet, come from its ``.msg`` file, which rosidl's parser reads.


_PATH = re.compile(r"[A-Za-z_]\w*(\[\d+\])*(\.[A-Za-z_]\w*(\[\d+\])*)*", re.ASCII)
_STEP = re.compile(r"(\w+)|\[(\d+)\]", re.ASCII)
_OF_CLASS = re.compile(r"(sequence<)?([\w/]+)(?:<\d+>)?(?:, \d+)?>?(?:\[(\d+)\])?", re.ASCII)


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


def parts_of_type(text: str) -> tuple[bool, str, str]:
    """Of a type as classes have it: whether it is a sequence, of what, and the size of an array.

    ``sequence<geometry_msgs/Point, 3>`` is ``(True, "geometry_msgs/Point", "")``.
    """
    found = _OF_CLASS.fullmatch(text)
    assert found is not None, text
    return bool(found[1]), found[2], found[3] or ""


def _of_class(text: str) -> MessageField:
    is_sequence, element, size = parts_of_type(text)
    package, _, name = element.rpartition("/")
    written = f"{package}/msg/{name}" if package else name
    return MessageField(written, is_array=bool(is_sequence or size))


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
