"""Types of ports: messages and arrays, their notation, and whether they exist on this machine.

The import of a message package takes tens of milliseconds. So a message is searched among the names
that ``msg/__init__.py`` of its package imports. The package is imported only if the name is not
there: a package may define its messages in other ways.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import re
import sys
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from neuros.project.suggest import did_you_mean, listed

_SHORT = re.compile(r"\A([A-Za-z]\w*)/([A-Za-z]\w*)\Z", re.ASCII)
_NOTATION = re.compile(r"([A-Za-z]\w*)(?:\.msg\.|/msg/)([A-Za-z]\w*)", re.ASCII)
_TEXTS = ("string", "wstring", "byte", "octet", "wchar")
_IMPORTED = re.compile(r"^\s*from\s+\S+\s+import\s+(\w+)", re.MULTILINE)


@dataclass(frozen=True)
class MessageField:
    """A field, or an element of one.

    Attributes:
        type: of the value, or of each element: ``double``, ``geometry_msgs/msg/Vector3``.
        is_array: whether the field has elements.
    """

    type: str
    is_array: bool

    @property
    def is_message(self) -> bool:
        """Whether the field is a message, with fields of its own."""
        return "/" in self.type and not self.is_array

    @property
    def has_numbers(self) -> bool:
        """Whether the field is a number, a truth value, or an array of these."""
        return "/" not in self.type and self.type not in _TEXTS

    def __str__(self) -> str:
        return f"an array of {self.type}" if self.is_array else self.type


class MessagePackages(Protocol):
    """Message packages of the project or its workspace; they need not be built yet."""

    def messages(self, package: str) -> Collection[str] | None:
        """The names of a package's messages, ``None`` if there is no such package."""

    def elsewhere(self, package: str, name: str) -> str:
        """The wrong folder in which a package has a message, in a sentence; empty if in none."""

    def installed(self, package: str) -> Path | None:
        """The folder of the built package, ``None`` if there is no such package."""

    def fields(self, package: str, name: str) -> Mapping[str, MessageField] | None:
        """The fields of a message, ``None`` if it is missing or its file is wrong."""


class NoPackages:
    """:class:`MessagePackages` without any package."""

    def messages(self, package: str) -> None:
        return None

    def elsewhere(self, package: str, name: str) -> str:
        return ""

    def installed(self, package: str) -> None:
        return None

    def fields(self, package: str, name: str) -> None:
        return None


NO_PACKAGES = NoPackages()


# ---------------------------------------------------------------------- arrays

_ARRAY = re.compile(r"(\w+) ?\[(.*)\]", re.ASCII)
_SHAPE = re.compile(r"[0-9]{1,10}( *, *[0-9]{1,10})*", re.ASCII)
_MOST_ARRAY_BYTES = 2**31 - 1  # the lengths and strides of a MultiArray have 32 bits
_ITEM_BYTES = {"bool": 1} | {
    f"{kind}{size}": size // 8
    for kind, sizes in (("int", (8, 16, 32, 64)), ("uint", (8, 16, 32, 64)), ("float", (32, 64)))
    for size in sizes
}
_OTHER_DTYPES = {
    **dict.fromkeys(("float", "double", "f8", "longdouble", "float96", "float128"), "float64"),
    **dict.fromkeys(("single", "f4", "half", "f2", "float16"), "float32"),
    **dict.fromkeys(("int", "i8", "long", "intp"), "int64"),
    **dict.fromkeys(("byte", "char", "u1"), "uint8"),
    **dict.fromkeys(("bool_", "boolean"), "bool"),
}
"""Other names of numbers, and those that no ROS message holds, with the type to write instead."""


class ArrayType(NamedTuple):
    """The type of a port whose packets are NumPy arrays, ``float64[18]``.

    Attributes:
        dtype: of NumPy, by its name: a bool, integer or float that ROS has a message for.
        shape: at least one dimension, each at least 1.
    """

    dtype: str
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """How many elements an array has."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """The bytes of an array."""
        return self.size * _ITEM_BYTES[self.dtype]

    @property
    def message(self) -> str:
        """The ROS message that an array is wherever it leaves NeuROS, ROS having no array of bool.

        Its ``layout`` has the shape.
        """
        kind = "UInt8" if self.dtype == "bool" else self.dtype.capitalize().replace("Uint", "UInt")
        return f"std_msgs/msg/{kind}MultiArray"

    def of_copies(self, copies: int) -> ArrayType:
        """The type of the arrays of all copies of a node, along a leading axis."""
        return self._replace(shape=(copies, *self.shape))

    @property
    def of_one_copy(self) -> ArrayType:
        """The type of one copy's array: the inverse of :meth:`of_copies`."""
        return self._replace(shape=self.shape[1:])

    def __str__(self) -> str:
        return f"{self.dtype}[{','.join(map(str, self.shape))}]"


@cache
def array_type(type_name: str) -> ArrayType | None:
    """The array type of that name; ``None`` if it is the name of a message, or wrong."""
    match = _ARRAY.fullmatch(type_name)
    if match is None or wrong_array(type_name):
        return None
    return ArrayType(match[1], tuple(map(int, match[2].split(","))))


def with_copies(type_name: str, copies: int | None) -> str:
    """The type of a port of a node with copies: an array gets a leading axis."""
    array = None if copies is None else array_type(type_name)
    return type_name if array is None or copies is None else str(array.of_copies(copies))


def ros_type(type_name: str) -> str:
    """The message type by which ROS knows the packets of a port of this type."""
    array = array_type(type_name)
    return type_name if array is None else array.message


def wrong_array(text: str) -> tuple[str, str] | None:
    """The problem with what looks like an array type, and a hint; ``None`` if there is none."""
    match = _ARRAY.fullmatch(text)
    if match is None:
        return None
    dtype, shape = match.groups()
    if dtype not in _ITEM_BYTES:
        instead = _OTHER_DTYPES.get(dtype)
        hint = f"write {instead}[{shape}]" if instead else did_you_mean(dtype, _ITEM_BYTES)
        has = f"an array holds {listed(_ITEM_BYTES)}"
        return f"'{text}': no ROS message holds an array of '{dtype}'", hint or has
    if not _SHAPE.fullmatch(shape):
        hint = f"write whole numbers, as in {dtype}[18] or {dtype}[480,640,3]"
        if not shape.strip():
            return f"'{text}': an array has a fixed shape", hint
        return f"'{text}': '{shape}' is not the shape of an array", hint
    found = ArrayType(dtype, tuple(map(int, shape.split(","))))
    if not found.size:
        return f"'{text}': each dimension is at least 1", ""
    if found.nbytes > _MOST_ARRAY_BYTES:
        return f"'{text}': an array has at most {_MOST_ARRAY_BYTES} bytes, not {found.nbytes}", ""
    return None


# ---------------------------------------------------------------------- messages


def normalised(text: str) -> str | None:
    """The one name of a type, ``None`` if it is none.

    ``std_msgs/msg/String`` for that or ``std_msgs.msg.String``, ``uint8[4,3]`` for ``uint8[4, 3]``.
    """
    if (array := array_type(text)) is not None:
        return str(array)
    match = _NOTATION.fullmatch(text)
    return f"{match[1]}/msg/{match[2]}" if match else None


def in_full(text: str) -> str:
    """``std_msgs/msg/String`` for ``std_msgs/String``, as Python may write it."""
    return _SHORT.sub(r"\1/msg/\2", text)


def unknown_type(
    type_name: str, *, must_be_here: bool, packages: MessagePackages = NO_PACKAGES
) -> tuple[str, str] | None:
    """The problem of a normalised type, and a hint; ``None`` if it exists, or may exist.

    Args:
        must_be_here: whether a package that is not installed on this machine is a problem.
        packages: of the project.
    """
    package, _, name = ros_type(type_name).split("/")
    folder = message_folder(package)
    own = packages.messages(package) if folder is None else None
    if own is not None:
        if name in own:
            return None
        text, hint = _no_message(type_name, own)
        return text, packages.elsewhere(package, name) or hint
    if folder is None:
        if not must_be_here:
            return None
        others = {
            init.parents[1].name
            for path in sys.path
            for init in Path(path).glob("*_*/msg/__init__.py")
        }
        return (
            f"unknown message type '{type_name}': there is no message package '{package}' here",
            similar_package(package, others)
            or f"a message of your own is workspace/{package}/msg/{name}.msg beside the project"
            f" file, with workspace/{package}/package.xml: docs/messages.md",
        )
    names = _IMPORTED.findall((folder / "__init__.py").read_text(encoding="utf-8"))
    if name in names or imported(package, name) is not None:
        return None
    return _no_message(type_name, names)


def similar_package(package: str, others: Iterable[str]) -> str:
    """A hint at the message package that may be meant; empty if none is similar."""
    # Most names end in _msgs, which would make all of them similar.
    ending = "_msgs" if package.endswith("_msgs") else ""
    stems = {each.removesuffix(ending) for each in others if each.endswith(ending)}
    return did_you_mean(package.removesuffix(ending), stems).replace("'?", f"{ending}'?")


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


# ---------------------------------------------------------------------- fields
#
# The fields of an installed message come from its class. The fields of a message of the project,
# which need not be built yet, come from its ``.msg`` file, which rosidl's parser reads.


_PATH = re.compile(r"[A-Za-z_]\w*(\[\d+\])*(\.[A-Za-z_]\w*(\[\d+\])*)*", re.ASCII)
_STEP = re.compile(r"(\w+)|\[(\d+)\]", re.ASCII)
_OF_CLASS = re.compile(r"(sequence<)?([\w/]+)(?:<\d+>)?(?:, \d+)?>?(?:\[(\d+)\])?", re.ASCII)


def fields_of(type_name: str, packages: MessagePackages) -> Mapping[str, MessageField] | None:
    """The fields of a message type, by name; ``None`` if its definition is not on this machine."""
    package, _, name = type_name.split("/")
    own = packages.fields(package, name)
    if own is not None:
        return own
    message = imported(package, name)
    if message is None:
        return None
    types: Mapping[str, str] = message.get_fields_and_field_types()
    fields = {}
    for key, text in types.items():
        is_sequence, element, size = parts_of_type(text)
        written = "/msg/".join(element.split("/"))
        fields[key] = MessageField(written, is_array=bool(is_sequence or size))
    return fields


def parts_of_type(text: str) -> tuple[bool, str, str]:
    """Whether a type in a message class is a sequence, its element, and the size of an array.

    ``sequence<geometry_msgs/Point, 3>`` is ``(True, "geometry_msgs/Point", "")``.
    """
    found = _OF_CLASS.fullmatch(text)
    assert found is not None, text
    return bool(found[1]), found[2], found[3] or ""


def misfit(type_name: str, path: str, packages: MessagePackages) -> tuple[str, str] | None:
    """The problem with the path of an array of numbers, and a hint; ``None`` if it may be right.

    Args:
        type_name: of the message, as ``sensor_msgs/msg/LaserScan``.
        path: as ``ranges`` or ``joints[0].effort``.
    """
    if not _PATH.fullmatch(path):
        return f"'{path}' is not the path of a field", "write it as 'joints[0].effort'"
    here, done = MessageField(ros_type(type_name), is_array=False), ""
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
    if here.has_numbers and here.is_array:
        return None
    hint = f"name an element, as '{done}[0]'" if here.is_array else ""
    if here.is_message:
        parts = fields_of(here.type, packages) or {}
        hint = f"name one of its fields: {listed(f'{done}.{each}' for each in parts)}"
    return f"'{path}' of {type_name} is {here}, not an array of numbers", hint
