"""Meshes of a description: files that MuJoCo reads, and those that have to be converted."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from neuros.convert.elements import Element
from neuros.convert.find import Finder, NotFound
from neuros.convert.report import Report

_READ_BY_MUJOCO = (".obj", ".stl", ".msh")
_CONVERTED = (".dae", ".glb", ".gltf", ".ply", ".off", ".3mf")
_CONVERTERS = ("trimesh", "collada")
SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
_HOW = "`pip install 'neuros[meshes]'` converts it"

Triangles = tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]
"""Vertices, shape (n, 3), metres, and the numbers of the corners of faces, shape (m, 3)."""


@dataclass
class Meshes:
    """The mesh assets of a model: each file and scale once.

    Attributes:
        made: those that MuJoCo cannot read itself, by the names of their assets.
    """

    spec: Any
    finder: Finder
    report: Report
    made: dict[str, Triangles] = field(default_factory=dict)
    _names: dict[tuple[Path, tuple[float, ...], bool], str | None] = field(default_factory=dict)
    _places: dict[str, Element] = field(default_factory=dict)

    def add(
        self, uri: Element, scale: tuple[float, ...], *, is_solid: bool, is_needed: bool
    ) -> str | None:
        """The name of the asset for the file that ``uri`` names.

        ``None`` if there is none: a missing file is a problem where it ``is_needed``, else a note.
        A solid one has a volume, from which MuJoCo computes its mass.
        """
        try:
            file = self.finder.find_file(uri.text, uri.file.parent)
        except NotFound as error:
            if is_needed:
                self.report.problem(uri, str(error), error.hint)
            else:
                self.report.note(uri, f"{error} ({error.hint})" if error.hint else str(error))
            return None
        key = (file, scale, is_solid)
        if key not in self._names:
            self._names[key] = self._new(uri, file, scale, is_solid)
        elif self._names[key] is None:
            self.report.note(uri, why_unread(file))
        return self._names[key]

    def blame(self) -> None:
        """Report the meshes that MuJoCo cannot use, once a model with them does not compile."""
        for mesh in self.spec.meshes:
            try:
                compile_alone(mesh, self.made.get(mesh.name))
            except ValueError as error:
                text = " ".join(str(error).removeprefix("Error: ").split())
                self.report.problem(self._places[mesh.name], f"MuJoCo cannot use the mesh: {text}")

    def _new(
        self, uri: Element, file: Path, scale: tuple[float, ...], is_solid: bool
    ) -> str | None:
        triangles = None
        if needs_conversion(file):
            triangles = triangles_of(file)
            if triangles is None:
                self.report.note(uri, why_unread(file))
                return None
        name, number = file.stem, 1
        while name in self._places:
            number += 1
            name = f"{file.stem}_{number}"
        self._places[name] = uri
        mesh = self.spec.add_mesh(name=name, scale=scale)
        if not is_solid:  # a thin shell may be open, or flat
            mesh.inertia = SHELL
        if triangles is None:
            mesh.file = str(file)
        else:
            fill(mesh, triangles)
            self.made[name] = triangles
        return name


def compile_alone(mesh: Any, triangles: Triangles | None, *, is_shown_only: bool = False) -> Any:
    """The ``MjModel`` of one mesh, which collides unless it ``is_shown_only``.

    ``triangles`` are its own, if it has no file. Raises ``ValueError``.
    """
    trial = mujoco.MjSpec()
    alone = trial.add_mesh(name=mesh.name, file=mesh.file, scale=mesh.scale)
    alone.inertia = SHELL if is_shown_only else mesh.inertia
    if triangles is not None:
        fill(alone, triangles)
    geom = trial.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name)
    if is_shown_only:
        geom.contype = geom.conaffinity = 0
    return trial.compile()


def why_unread(file: Path) -> str:
    """Why a file that needs conversion has no triangles here, and what to do."""
    kind = "STL in text form" if _is_text_stl(file) else f"{file.suffix or 'such'} files"
    if file.suffix.lower() not in (*_CONVERTED, ".stl"):
        return f"MuJoCo does not read {kind}: convert it to OBJ"
    if not all(map(find_spec, _CONVERTERS)):
        return f"MuJoCo does not read {kind}: {_HOW}"
    return "no triangles can be read from it (is it damaged?): convert it to OBJ"


def needs_conversion(file: Path) -> bool:
    """Whether MuJoCo does not read a file of this kind."""
    return file.suffix.lower() not in _READ_BY_MUJOCO or _is_text_stl(file)


def fill(mesh: Any, triangles: Triangles) -> None:
    """Give a mesh of a spec its triangles."""
    vertices, faces = triangles
    mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()


def _is_text_stl(file: Path) -> bool:
    """Whether an STL file is one in text form, by its size: a binary one says how long it is."""
    if file.suffix.lower() != ".stl":
        return False
    with file.open("rb") as stl:
        head = stl.read(84)
    count = int.from_bytes(head[80:84], "little")
    return head.startswith(b"solid") and file.stat().st_size != 84 + 50 * count


def triangles_of(file: Path) -> Triangles | None:
    """The triangles of a file of another kind in metres; ``None`` if nothing here reads it.

    The axes are taken as they are, as Gazebo does, whatever the file calls up.
    """
    try:
        import trimesh

        scene = trimesh.load_scene(str(file))
        mesh = scene.to_geometry()
        unit = float(trimesh.units.unit_conversion(mesh.units or "meters", "meters"))
    except Exception:  # readers of other people's make raise anything for a damaged file
        return None
    if not len(getattr(mesh, "faces", ())):
        return None
    return np.asarray(mesh.vertices, float) * unit, np.asarray(mesh.faces, np.int32)
