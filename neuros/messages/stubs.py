"""Stubs of message classes, so that editors and type checkers know the fields of a packet.

rclpy's classes have no annotations. A stub file (PEP 561) has the fields of each class, as
``get_fields_and_field_types`` lists them, with the types that NeuROS accepts for a field: a plain
number for a number, a list or an array for a sequence of numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from neuros.project.message_types import parts_of_type

_HEAD = """\
# Made by `neuros types`: the fields of {package}'s messages. Make it again when those change.
"""
# Names that annotations may use, and their imports.
_IMPORTS = {
    " array[": "from array import array",
    "Sequence[": "from collections.abc import Sequence",
    "Any": "from typing import Any",
    "ClassVar[": "from typing import ClassVar",
    "np.": "import numpy as np",
}
# PEP 484: for modules without stubs, such as srv, which checkers would report as missing. Pyright
# needs a file for each, too.
_OTHER_MODULES = """\
# pyright: reportIncompleteStub=false
from typing import Any

def __getattr__(name: str) -> Any: ...
"""
_SCALARS = {
    **dict.fromkeys(("float", "double"), "float"),
    **dict.fromkeys(("string", "wstring"), "str"),
    **dict.fromkeys(("octet",), "bytes"),
    "boolean": "bool",
}
_IN_ARRAYS = {"int", "float"}


def write_stubs(types: Iterable[str], folder: Path) -> list[Path]:
    """Write stubs of all packages of these types, and of packages that they need.

    Args:
        types: in ROS notation, ``sensor_msgs/msg/Imu``; their packages can be imported.
        folder: for a folder of each package.

    Returns:
        The files.

    Raises:
        OSError: if a file cannot be written.
    """
    wanted = {name.partition("/")[0] for name in types}
    done: dict[str, str] = {}
    while todo := wanted - done.keys():
        package = min(todo)
        done[package], needed = _stub(package)
        wanted |= needed
    files = []
    for package, text in sorted(done.items()):
        file = folder / package / "msg" / "__init__.pyi"
        file.parent.mkdir(parents=True, exist_ok=True)
        for module in ("", "srv", "action"):
            if not module or find_spec(f"{package}.{module}"):
                other = folder / package / module / "__init__.pyi"
                other.parent.mkdir(exist_ok=True)
                other.write_text(_OTHER_MODULES, "utf-8")
        file.write_text(text, "utf-8")
        files.append(file)
    return files


def _stub(package: str) -> tuple[str, set[str]]:
    """The text for a package, and the packages whose messages it names."""
    module = import_module(f"{package}.msg")
    found = (getattr(module, name) for name in sorted(vars(module)))
    classes = [each for each in found if hasattr(each, "get_fields_and_field_types")]
    fields = {each: each.get_fields_and_field_types() for each in classes}
    elements = (parts_of_type(kind)[1] for types in fields.values() for kind in types.values())
    needed = {element.partition("/")[0] for element in elements if "/" in element} - {package}
    text = ""
    for each in classes:
        constants = getattr(type(each), f"_{type(each).__name__}__constants", {})
        lines = [f"{n}: ClassVar[{type(value).__name__}]" for n, value in constants.items()]
        lines += _fields(fields[each], package)
        text += f"\nclass {each.__name__}:\n" + "".join(f"    {line}\n" for line in lines)
    imports = [line for use, line in _IMPORTS.items() if use in text]
    imports += [f"import {each}.msg" for each in sorted(needed)]
    return "\n".join([_HEAD.format(package=package) + "\n".join(imports), text]), needed


def _fields(types: dict[str, str], package: str) -> Iterator[str]:
    """The lines of the fields, and of the constructor with its keyword arguments."""
    arguments = []
    for name, kind in types.items():
        read, written = _annotations(kind, package)
        arguments.append(f"{name}: {written} = ...")
        if read == written:
            yield f"{name}: {read}"
        else:
            yield "@property"
            yield f"def {name}(self) -> {read}: ..."
            yield f"@{name}.setter"
            yield f"def {name}(self, value: {written}) -> None: ..."
    keywords = ", ".join(["self", *(["*", *arguments] if arguments else [])])
    yield f"def __init__({keywords}) -> None: ..."
    yield "@classmethod"
    yield "def get_fields_and_field_types(cls) -> dict[str, str]: ..."


def _annotations(kind: str, package: str) -> tuple[str, str]:
    """The type of a field when it is read, and the types that it accepts."""
    is_sequence, element, length = parts_of_type(kind)
    if "/" in element:
        of, name = element.split("/")
        plain = name if of == package else f"{of}.msg.{name}"
    else:
        plain = _SCALARS.get(element, "int")
    if length and plain in _IN_ARRAYS:
        return "np.ndarray[Any, Any]", f"Sequence[{plain}] | np.ndarray[Any, Any]"
    if is_sequence and plain in _IN_ARRAYS:
        return f"array[{plain}]", f"Sequence[{plain}] | np.ndarray[Any, Any] | bytes"
    if is_sequence or length:
        return f"list[{plain}]", f"Sequence[{plain}]"
    return plain, plain
