"""Message definitions: a bag brings them along, so that it can be read where the types are not."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from neuros.errors import EnvironmentFault


class Definitions:
    """The definitions of message types: those that come with ROS, and what is installed here."""

    def __init__(self) -> None:
        self.store: Typestore = get_typestore(Stores.ROS2_JAZZY)

    def add(self, type_name: str) -> None:
        """See to it that the store has a type, and all types of its fields.

        Raises:
            EnvironmentFault: if no definition of one of them is found.
        """
        if type_name in self.store.fielddefs:
            return
        path = _file_of(type_name)
        if path is None:
            raise EnvironmentFault(
                f"message type {type_name} cannot be recorded: its definition"
                f" (share/{type_name}.msg) is not installed here"
            )
        types = get_types_from_msg(path.read_text("utf-8"), type_name)
        for used in _types_of_fields(types[type_name][1]):
            if used.endswith("/msg/wstring"):
                raise EnvironmentFault(
                    f"message type {type_name} cannot be recorded: it has a wstring, which the"
                    " library that writes bags does not know; use string, which is UTF-8"
                )
            if used != type_name:
                self.add(used)
        self.store.register(types)


def _file_of(type_name: str) -> Path | None:
    """Where a message package is installed, so is its share folder, some folders further up."""
    try:
        spec = importlib.util.find_spec(type_name.split("/")[0])
    except (ImportError, ValueError):
        spec = None
    for location in (spec.submodule_search_locations or ()) if spec else ():
        for folder in Path(location).parents:
            path = folder / "share" / f"{type_name}.msg"
            if path.is_file():
                return path
    return None


def _types_of_fields(fields: object) -> list[str]:
    """The message types in rosbags' description of fields."""
    found: list[str] = []
    if isinstance(fields, str):
        if "/" in fields:
            found.append(fields)
    elif isinstance(fields, (list, tuple)):
        for part in fields:
            found += _types_of_fields(part)
    return found
