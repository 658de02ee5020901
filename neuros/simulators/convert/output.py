"""Model under construction, and the result as an MJCF file with the meshes made for it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from neuros.simulators.convert.elements import Element, NotTaken
from neuros.simulators.convert.meshes import Meshes, Triangles
from neuros.simulators.convert.poses import Pose
from neuros.simulators.convert.scopes import Link

MARK = "made by `neuros convert`"
"""Stands in the first line of every file that is written here, and may be overwritten."""


@dataclass
class Building:
    """A model under construction.

    Attributes:
        spec: the ``MjSpec``.
        bodies: its bodies by the id of their links.
        geoms: the geoms made from collisions, by the id of their elements.
        colliding_meshes: the <mesh> of collisions, by the names of their geoms.
        masks: what collisions say that they collide with, by the id of their elements.
        joints: the names of the joints made from a joint, by its name.
    """

    spec: Any
    meshes: Meshes
    bodies: dict[int, Any] = field(default_factory=dict)
    geoms: dict[int, Any] = field(default_factory=dict)
    masks: dict[int, int] = field(default_factory=dict)
    colliding_meshes: dict[str, Element] = field(default_factory=dict)
    joints: dict[str, list[str]] = field(default_factory=dict)
    _names: dict[tuple[str, str], int] = field(default_factory=lambda: {("body", "world"): 1})

    def body(self, link: Link | None) -> Any:
        """The body of a link; the world without one."""
        return self.spec.worldbody if link is None else self.bodies[id(link)]

    def name(self, sort: str, wanted: str, element: Element | None) -> str:
        """A name that no other element of its sort (geom, site, ...) has; a change is noted."""
        name, number = wanted, self._names.get((sort, wanted), 0) + 1
        while number > 1 and (sort, name := f"{wanted}_{number}") in self._names:
            number += 1
        self._names[sort, wanted] = number
        self._names.setdefault((sort, name), 1)
        if number > 1 and element is not None:
            element.remark(f"called '{name}': the name is taken")
        return name


def put(thing: Any, pose: Pose, seen_from: Pose) -> None:
    """Place an element of the spec whose pose in the world is ``pose``."""
    local = seen_from.inverse() @ pose
    thing.pos, thing.quat = local.position, local.quaternion


def set_first(thing: Any, attribute: str, value: float) -> None:
    """Set a number, or the first of several: MuJoCo 4 made polynomials of some numbers."""
    if np.ndim(getattr(thing, attribute)):
        getattr(thing, attribute)[0] = value
    else:
        setattr(thing, attribute, value)


@dataclass(frozen=True)
class Converted:
    """A description as MuJoCo has it.

    Attributes:
        spec: the ``MjSpec``; its meshes have absolute paths.
        not_taken: what of the description it does not have.
        made_meshes: triangles of those meshes that MuJoCo cannot read itself, by their names.
        bodies, joints: how many there are.
    """

    spec: Any
    not_taken: Sequence[NotTaken]
    made_meshes: dict[str, Triangles]
    bodies: int
    joints: int


def write_mjcf(converted: Converted, source: Path, output: Path) -> list[Path]:
    """Write MJCF, what was not taken over as a comment in it; returns all files written.

    Meshes are named relative to the file. It is compiled once more from the disk before it takes
    its name, so that a file that is there works.

    Raises ``OSError``, and ``ValueError`` if MuJoCo does not read what it wrote.
    """
    spec = converted.spec.copy()
    spec.modelfiledir = str(output.resolve().parent)
    folder = Path(spec.modelfiledir)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for mesh in spec.meshes:
        if mesh.name in converted.made_meshes:
            file = folder / f"{output.stem}_meshes" / f"{_file_name(mesh.name)}.obj"
            while file in written:  # names that differ in what no file name has
                file = file.with_stem(f"{file.stem}_")
            _write_obj(file, converted.made_meshes[mesh.name])
            written.append(file)
            mesh.uservert, mesh.userface, mesh.file = [], [], str(file)
        mesh.file = os.path.relpath(mesh.file, folder)
    draft = folder / f".{output.stem}.draft.xml"
    try:
        draft.write_text(_comment(converted, source) + spec.to_xml(), "utf-8")
        mujoco.MjSpec.from_file(str(draft)).compile()
        draft.replace(output)
    finally:
        draft.unlink(missing_ok=True)
    return [output, *written]


def is_ours(file: Path) -> bool:
    """Whether a file was written here."""
    with file.open(encoding="utf-8", errors="replace") as text:
        return MARK in text.readline()


def _comment(converted: Converted, source: Path) -> str:
    lines = [f"{MARK} from {source.name}"]
    if converted.not_taken:
        lines += ["", "Not taken over, or not as it was:"]
        lines += [f"  {note}" for note in converted.not_taken]
    text = "\n".join(lines).replace("--", "- -")
    return f"<!-- {text}\n-->\n"


def _write_obj(file: Path, triangles: Triangles) -> None:
    vertices, faces = triangles
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    file.write_text("\n".join(lines) + "\n", "ascii")


def _file_name(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in name)
