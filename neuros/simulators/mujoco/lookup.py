"""Elements of a model that a node file names, and the problems of its declarations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import mujoco

from neuros.errors import ModelError
from neuros.project.message_types import array_type

_SORTS = {
    "site": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "body": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "geom": (mujoco.mjtObj.mjOBJ_GEOM, "ngeom"),
    "camera": (mujoco.mjtObj.mjOBJ_CAMERA, "ncam"),
    "joint": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "sensor": (mujoco.mjtObj.mjOBJ_SENSOR, "nsensor"),
    "actuator": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nu"),
}


class Problems:
    """Problems of one file, raised together in one ``ModelError``.

    Args:
        file: named at the start of each problem.
        hint: added to the end of each.

    Attributes:
        found: (pointer, text) of each problem; the pointer is empty for one of another file.
    """

    def __init__(self, file: object, hint: str = "") -> None:
        self._file, self._hint = file, hint
        self.found: list[tuple[str, str]] = []

    def add(self, pointer: str, text: str) -> None:
        self.found.append((pointer, f"{text}{self._hint}"))

    def add_text(self, text: str) -> None:
        """Add a problem of another file; the text names that file."""
        self.found.append(("", text))

    def raise_any(self) -> None:
        if self.found:
            texts = (f"{self._file}: {at}: {text}" if at else text for at, text in self.found)
            raise ModelError("\n".join(texts))


class Faults:
    """Problems of one ``mujoco`` object."""

    def __init__(self, pointer: str, problems: Problems) -> None:
        self._pointer, self._problems, self.found = pointer, problems, False

    def add(self, key: str, text: str) -> None:
        self.found = True
        self._problems.add(f"{self._pointer}/{key}" if key else self._pointer, text)

    def unknown_keys(self, declared: Mapping[str, Any], known: Sequence[str]) -> None:
        for key in declared:
            if key not in known:
                self.add(key, f"unknown key{did_you_mean(key, known)}")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """``" (did you mean 'x'?)"``, else the first few possibilities, else nothing."""
    names = sorted(name for name in known if name)
    close = get_close_matches(word, names, n=1)
    if close:
        return f" (did you mean '{close[0]}'?)"
    if not names:
        return ""
    return f" (there are: {', '.join(names[:8])}{', ...' if len(names) > 8 else ''})"


def form_of(type_name: str) -> str:
    """The type of a port without the shape of an array: ``float64[...]``."""
    array = array_type(type_name)
    return type_name if array is None else f"{array.dtype}[...]"


def is_list_of_names(value: object) -> bool:
    return (
        isinstance(value, list | tuple)
        and bool(value)
        and all(isinstance(name, str) and name for name in value)
        and len(set(value)) == len(value)
    )


def names_of(model: Any, sort: str) -> list[str]:
    """The names of all elements of one sort, ``""`` for one without a name, by id."""
    kind, count = _SORTS[sort]
    return [mujoco.mj_id2name(model, kind.value, i) or "" for i in range(getattr(model, count))]


def id_of(model: Any, sort: str, name: str) -> int:
    """The id of an element; -1 if there is none of that name."""
    return int(mujoco.mj_name2id(model, _SORTS[sort][0].value, name))


def has_any(model: Any, name: str) -> bool:
    return any(id_of(model, sort, name) >= 0 for sort in _SORTS)


def find(
    model: Any, sorts: Sequence[str], name: str, pointer: str, problems: Problems
) -> tuple[str, int] | None:
    """The sort and id of the element called ``name``; the first of ``sorts`` that has it wins."""
    for sort in sorts:
        if (index := id_of(model, sort, name)) >= 0:
            return sort, index
    known = [known for sort in sorts for known in names_of(model, sort) if known != "world"]
    hint = did_you_mean(name, known)
    problems.add(pointer, f"the model has no {' or '.join(sorts)} '{name}'{hint}")
    return None
