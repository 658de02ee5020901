"""Names of a model's elements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco

from neuros.simulators.mujoco.declarations import Problems, did_you_mean

_OBJECTS = {
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "camera": mujoco.mjtObj.mjOBJ_CAMERA,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}
_COUNTS = {
    "site": "nsite",
    "body": "nbody",
    "geom": "ngeom",
    "camera": "ncam",
    "joint": "njnt",
    "actuator": "nu",
}


def names_of(model: Any, what: str) -> list[str]:
    """The names of all elements of one sort, ``""`` for one without a name, by id."""
    count = getattr(model, _COUNTS[what])
    return [mujoco.mj_id2name(model, _OBJECTS[what].value, index) or "" for index in range(count)]


def has_any(model: Any, name: str) -> bool:
    """Whether an element of any sort has this name."""
    return any(mujoco.mj_name2id(model, sort.value, name) >= 0 for sort in _OBJECTS.values())


def find(
    model: Any, sorts: Sequence[str], name: str, pointer: str, problems: Problems
) -> tuple[str, int] | None:
    """The sort and id of the element called ``name``; the first of ``sorts`` that has it wins."""
    for what in sorts:
        index = mujoco.mj_name2id(model, _OBJECTS[what].value, name)
        if index >= 0:
            return what, index
    known = [known for what in sorts for known in names_of(model, what) if known != "world"]
    hint = did_you_mean(name, known)
    problems.add(pointer, f"the model has no {' or '.join(sorts)} '{name}'{hint}")
    return None
