"""A model under construction, its meshes, and the result as an MJCF file.

MuJoCo reads some meshes itself, others are converted. MuJoCo collides the convex hull of a mesh; a
flat mesh (a floor of two triangles, say) has none, so a thin box replaces it.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from neuros.errors import DescriptionError, Problem
from neuros_robots.elements import Difference, Element, Finder, NotFound
from neuros_robots.frames import Link, Pose, Vector, from_quaternion

MARK = "made by `neuros convert`"
"""Stands in the first line of every file written here; such files may be overwritten."""
_READ_BY_MUJOCO = (".obj", ".stl", ".msh")
_CONVERTED = (".dae", ".glb", ".gltf", ".ply", ".off", ".3mf")
_CONVERTERS = ("trimesh", "collada")
_FREE = mujoco.mjtJoint.mjJNT_FREE
_SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
_HOW = "`pip install 'neuros[meshes]'` converts it"
Triangles = tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]
"""Vertices, shape (n, 3), metres, and the numbers of the corners of faces, shape (m, 3)."""
_ROUNDED = 2e-5  # twice what rounding adds to the largest moment of inertia
_FLAT = 1e-4  # largest ratio of thickness to length of a flat mesh
_THICKNESS_M = 0.01
_RECTANGULAR = 0.999  # smallest share of a rectangle that a rectangular mesh fills


@dataclass
class Building:
    """A model under construction.

    Attributes:
        spec: the ``MjSpec``.
        bodies: its bodies by the id of their links.
        geoms: the geoms made from collisions, by the id of their elements.
        colliding_meshes: the <mesh> of collisions, by the names of their geoms.
        masks: the collision masks of collisions, by the id of their elements.
        joints: the names of MuJoCo's joints for a joint, by its name.
        places: the elements of named things, by their names, for errors of MuJoCo's.
    """

    spec: Any
    meshes: Meshes
    bodies: dict[int, Any] = field(default_factory=dict)
    geoms: dict[int, Any] = field(default_factory=dict)
    masks: dict[int, int] = field(default_factory=dict)
    colliding_meshes: dict[str, Element] = field(default_factory=dict)
    joints: dict[str, list[str]] = field(default_factory=dict)
    places: dict[str, Element] = field(default_factory=dict)
    _names: dict[tuple[str, str], int] = field(default_factory=lambda: {("body", "world"): 1})

    def body(self, link: Link | None) -> Any:
        """The body of a link, or for ``None`` the world."""
        return self.spec.worldbody if link is None else self.bodies[id(link)]

    def add(
        self,
        sort: str,
        link: Link | None,
        pose: Pose,
        name: str,
        element: Element | None,
        **attributes: Any,
    ) -> Any:
        """Add a geom, site, camera, light or body, whose ``pose`` is in the world, to a link.

        A change of its name is reported at ``element``.
        """
        thing = getattr(self.body(link), f"add_{sort}")(**attributes)
        thing.name = self.name(sort, name, element)
        local = (Pose() if link is None else link.pose).inverse() @ pose
        thing.pos = local.position
        if hasattr(thing, "quat"):
            thing.quat = local.quaternion
        return thing

    def name(self, sort: str, wanted: str, element: Element | None) -> str:
        """A name that is unique in its sort (geom, site, ...); a change is reported."""
        name, number = wanted, self._names.get((sort, wanted), 0) + 1
        while number > 1 and (sort, name := f"{wanted}_{number}") in self._names:
            number += 1
        self._names[sort, wanted] = number
        self._names.setdefault((sort, name), 1)
        if element is not None:
            self.places[name] = element
            if number > 1:
                element.remark(f"called '{name}': the name is taken")
        return name


@dataclass(frozen=True)
class Converted:
    """A converted description.

    Attributes:
        spec: the ``MjSpec``; its meshes have absolute paths.
        differences: parts of the description that it lacks, or has in another form.
        made_meshes: triangles of the converted meshes, by their names.
        bodies, joints: their numbers.
        may_move: whether the root stands in the world since the format cannot say that it moves.
    """

    spec: Any
    differences: Sequence[Difference]
    made_meshes: dict[str, Triangles]
    bodies: int
    joints: int
    may_move: bool = False


def finished(building: Building, roots: Sequence[Element]) -> Converted:
    """Compile the model that was made from documents, whose unread elements are listed.

    Raises ``DescriptionError``.
    """
    report, spec = roots[0].report, building.spec
    report.raise_any()
    spec.compiler.degree = False
    while True:
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                model, boxed = _compile_boxed(spec, building.meshes.made, caught)
            break
        except (ValueError, mujoco.FatalError) as error:
            if not building.meshes.drop_unusable():
                if not report.problems:
                    named = re.search(r"\bname '([^']*)'", message_of(error))
                    place = building.places.get(named[1]) if named else None
                    (place or roots[0]).problem(
                        f"MuJoCo cannot compile the converted model: {message_of(error)}"
                    )
                report.raise_any()
    why = {geom.name: str(slab) for geom, slab in boxed}
    for name, mesh in building.colliding_meshes.items():
        mesh.remark(why.get(name, "MuJoCo collides the convex hull of a mesh"))
    for warning in caught:
        roots[0].remark(f"MuJoCo: {' '.join(str(warning.message).split())}")
    report.omit_unread(roots)
    made = building.meshes.made
    return Converted(spec, report.differences(), made, model.nbody - 1, model.njnt)


def read_mjcf(file: Path, finder: Finder) -> Converted:
    """A robot in MJCF as it is; the files that it names get absolute paths.

    Raises ``DescriptionError``.
    """
    del finder  # MuJoCo finds files itself
    try:
        if file.suffix.lower() == ".xml":
            spec = mujoco.MjSpec.from_file(str(file))
        else:  # which MuJoCo does not open
            spec = mujoco.MjSpec.from_string(file.read_text("utf-8"))
            spec.modelfiledir = str(file.resolve().parent)
        model = spec.copy().compile()
    except (ValueError, mujoco.FatalError) as error:
        text = message_of(error)
        line = re.search(r"\bline (\d+)", text)
        problem = Problem(str(file), int(line[1]) if line else 1, 1, "/", text)
        raise DescriptionError([problem]) from error
    for things, folder in _assets(spec, spec.meshdir, spec.texturedir):
        for thing in things:
            if thing.file:
                thing.file = str(file.resolve().parent / folder / thing.file)
    spec.meshdir = spec.texturedir = ""
    # A node file names what it reads and drives.
    for number, body in enumerate(spec.bodies):
        body.name = body.name or f"body{number}"
    for joint in spec.joints:
        if not joint.name:
            joint.name = f"{joint.parent.name}/{'free' if joint.type == _FREE else 'joint'}"
    return Converted(spec, (), {}, model.nbody - 1, model.njnt)


def _assets(spec: Any, meshes: str = "", textures: str = "") -> Iterator[tuple[Any, str]]:
    """All that a spec reads from files, each with one of two folders."""
    yield from ((spec.meshes, meshes), (spec.hfields, meshes), (spec.skins, meshes))
    yield spec.textures, textures


def write_mjcf(converted: Converted, source: Path, output: Path) -> list[Path]:
    """Write MJCF with the differences in a comment; returns all written files.

    Meshes are named relative to the file. A draft is compiled from the disk before it gets its
    name, so that an existing file works.

    Raises ``OSError``, and ``DescriptionError`` if MuJoCo cannot read the draft.
    """
    spec = converted.spec.copy()
    for body in spec.bodies:
        if body.explicitinertial:
            _make_roundable(body)
    spec.modelfiledir = str(output.resolve().parent)
    folder = Path(spec.modelfiledir)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for mesh in spec.meshes:
        if mesh.name in converted.made_meshes:
            name = re.sub(r"[^\w.-]", "_", mesh.name)
            file = folder / f"{output.stem}_meshes" / f"{name}.obj"
            while file in written:  # different names may become the same file name
                file = file.with_stem(f"{file.stem}_")
            vertices, faces = converted.made_meshes[mesh.name]
            file.parent.mkdir(parents=True, exist_ok=True)
            rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
            rows += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
            file.write_text("\n".join(rows) + "\n", "ascii")
            written.append(file)
            mesh.uservert, mesh.userface, mesh.file = [], [], str(file)
    for things, _ in _assets(spec):
        for thing in things:
            if thing.file:
                thing.file = os.path.relpath(thing.file, folder)
    lines = [f"{MARK} from {source.name}"]
    if converted.differences:
        lines += ["", "Not taken over, or not as it was:"]
        lines += [f"  {note}" for note in converted.differences]
    comment = "\n".join(lines).replace("--", "- -")
    draft = folder / f".{output.stem}.draft.xml"
    try:
        draft.write_text(f"<!-- {comment}\n-->\n{spec.to_xml()}", "utf-8")
        mujoco.MjSpec.from_file(str(draft)).compile()
        draft.replace(output)
    except ValueError as error:
        text = f"MuJoCo cannot read its own output: {message_of(error)}"
        raise DescriptionError([Problem(str(source), 1, 1, "/", text)]) from error
    finally:
        draft.unlink(missing_ok=True)
    return [output, *written]


def _make_roundable(body: Any) -> None:
    """Let the inertia of a flat body stay possible when it is rounded to six digits."""
    order = np.argsort(body.inertia)
    moments = np.array(body.inertia)
    lack = moments[order[2]] * (1 + _ROUNDED) - moments[order[:2]].sum()
    if lack > 0:
        moments[order[:2]] += lack / 2
        body.inertia = moments


def is_ours(file: Path) -> bool:
    """Whether a file was written by :func:`write_mjcf`."""
    with file.open(encoding="utf-8", errors="replace") as text:
        return MARK in text.readline()


@dataclass
class Meshes:
    """The mesh assets of a model: each file and scale once.

    Attributes:
        made: the converted ones, by the names of their assets.
    """

    spec: Any
    finder: Finder
    made: dict[str, Triangles] = field(default_factory=dict)
    _names: dict[tuple[Path, tuple[float, ...], bool], str | None] = field(default_factory=dict)
    _places: dict[str, Element] = field(default_factory=dict)

    def add_file(self, uri: Element, scale: tuple[float, ...], *, is_solid: bool) -> str | None:
        """The name of the asset for the file that ``uri`` names; ``None`` after a problem.

        MuJoCo computes the mass of a solid mesh from its volume.
        """
        try:
            file = self.finder.find_file(uri.text, uri.file.parent)
        except NotFound as error:
            uri.problem(str(error), error.hint)
            return None
        key = (file, scale, is_solid)
        if key not in self._names:
            source = _triangles_of(file) if _needs_conversion(file) else file
            self._names[key] = (
                None
                if source is None
                else self.add(uri, file.stem, source, scale, is_solid=is_solid)
            )
        if self._names[key] is None:
            uri.problem(_why_unread(file))
        return self._names[key]

    def add_heights(self, uri: Element, size: tuple[float, ...]) -> tuple[str, float] | None:
        """The name of a height field and the share of its height where it is lowest.

        MuJoCo stretches the brightness of a picture from its darkest to its brightest point.
        ``None`` after a problem.

        Args:
            size: half lengths along x and y, and the height of white, in metres.
        """
        try:
            file = self.finder.find_file(uri.text, uri.file.parent)
        except NotFound as error:
            uri.problem(str(error), error.hint)
            return None
        picture = mujoco.MjSpec()
        picture.add_texture(name="t", type=mujoco.mjtTexture.mjTEXTURE_2D, file=str(file))
        try:
            pixels = picture.compile().tex_data
        except ValueError as error:
            uri.problem(f"no heights can be read from it ({message_of(error)})", "MuJoCo reads PNG")
            return None
        darkest, brightest = int(pixels.min()) / 255, int(pixels.max()) / 255
        name, number = file.stem, 1
        while self.spec.hfield(name) is not None:
            number += 1
            name = f"{file.stem}_{number}"
        top_m = max((brightest - darkest) * size[2], mujoco.mjMINVAL)
        self.spec.add_hfield(name=name, file=str(file), size=[*size[:2], top_m, _THICKNESS_M])
        return name, darkest

    def drop_unusable(self) -> bool:
        """Drop unusable meshes that are only seen; those that collide are problems.

        Returns whether any was dropped.
        """
        dropped = False
        for mesh in list(self.spec.meshes):
            try:
                _compile_alone(mesh, self.made.get(mesh.name))
            except ValueError as error:
                text = f"MuJoCo cannot use the mesh: {message_of(error)}"
                geoms = [geom for geom in self.spec.geoms if geom.meshname == mesh.name]
                if any(geom.contype or geom.conaffinity for geom in geoms):
                    self._places[mesh.name].problem(text)
                    continue
                self._places[mesh.name].omit(f"left out: {text}")
                for thing in (*geoms, mesh):
                    self.spec.delete(thing)
                dropped = True
        return dropped

    def add(
        self,
        place: Element,
        wanted: str,
        source: Path | Triangles,
        scale: tuple[float, ...] = (1.0, 1.0, 1.0),
        *,
        is_solid: bool,
    ) -> str:
        """The name of a new asset, from a file that MuJoCo reads or from triangles."""
        name, number = wanted, 1
        while name in self._places:
            number += 1
            name = f"{wanted}_{number}"
        self._places[name] = place
        mesh = self.spec.add_mesh(name=name, scale=scale)
        if not is_solid:  # a thin shell may be open, or flat
            mesh.inertia = _SHELL
        if isinstance(source, Path):
            mesh.file = str(source)
        else:
            _fill(mesh, source)
            self.made[name] = source
        return name


def message_of(error: Exception) -> str:
    """The message of an error of MuJoCo's compiler, in one line."""
    return " ".join(str(error).removeprefix("Error: ").split())


def _compile_alone(mesh: Any, triangles: Triangles | None, *, is_shown_only: bool = False) -> Any:
    """The ``MjModel`` of one mesh, which collides unless it ``is_shown_only``.

    ``triangles`` are those of a mesh without a file. Raises ``ValueError``.
    """
    trial = mujoco.MjSpec()
    alone = trial.add_mesh(name=mesh.name, file=mesh.file, scale=mesh.scale)
    alone.inertia = _SHELL if is_shown_only else mesh.inertia
    if triangles is not None:
        _fill(alone, triangles)
    geom = trial.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name)
    if is_shown_only:
        geom.contype = geom.conaffinity = 0
    return trial.compile()


def _why_unread(file: Path) -> str:
    """Why a file that needs conversion has no triangles, and what to do."""
    kind = "STL in text form" if _is_text_stl(file) else f"{file.suffix or 'such'} files"
    if file.suffix.lower() not in (*_CONVERTED, ".stl"):
        return f"MuJoCo does not read {kind}: convert it to OBJ"
    if not all(map(find_spec, _CONVERTERS)):
        return f"MuJoCo does not read {kind}: {_HOW}"
    return "no triangles can be read from it (is it damaged?): convert it to OBJ"


def _needs_conversion(file: Path) -> bool:
    """Whether MuJoCo does not read a file of this kind."""
    return file.suffix.lower() not in _READ_BY_MUJOCO or _is_text_stl(file)


def _fill(mesh: Any, triangles: Triangles) -> None:
    vertices, faces = triangles
    mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()


def _is_text_stl(file: Path) -> bool:
    """Whether a file is STL in text form: the size of a binary one follows from its header."""
    if file.suffix.lower() != ".stl":
        return False
    with file.open("rb") as stl:
        head = stl.read(84)
    count = int.from_bytes(head[80:84], "little")
    return head.startswith(b"solid") and file.stat().st_size != 84 + 50 * count


def _triangles_of(file: Path) -> Triangles | None:
    """The triangles of a file in metres, axes unchanged as in Gazebo; ``None`` if unreadable."""
    try:
        import trimesh

        scene = trimesh.load_scene(str(file))
        mesh = scene.to_geometry()
        unit = float(trimesh.units.unit_conversion(mesh.units or "meters", "meters"))
    except Exception:  # readers of third parties raise anything for a damaged file
        return None
    if not len(getattr(mesh, "faces", ())):
        return None
    return np.asarray(mesh.vertices, float) * unit, np.asarray(mesh.faces, np.int32)


@dataclass(frozen=True)
class Slab:
    """A flat mesh as a box: half lengths in metres; ``pose`` is seen from the mesh."""

    half_lengths: Vector
    pose: Pose
    is_rectangular: bool

    def __str__(self) -> str:
        size = " x ".join(f"{2 * length:.4g}" for length in self.half_lengths)
        outline = "" if self.is_rectangular else ", which is more than the mesh covers"
        return f"MuJoCo cannot collide a flat mesh: a box of {size} m stands in its place{outline}"


def _compile_boxed(
    spec: Any, made: dict[str, Triangles], caught: list[Any]
) -> tuple[Any, list[tuple[Any, Slab]]]:
    """Compile a copy of an uncompiled spec, with boxes for flat meshes that collide.

    Args:
        made: triangles of meshes without a file.
        caught: warnings; those of the first attempt are dropped.

    Returns:
        The ``MjModel``, and the geoms that became boxes. Raises MuJoCo's errors.
    """
    try:
        model = spec.copy().compile()  # a copy: MuJoCo 3 keeps the meshes of compiled geoms
        # A mesh that is flat but for rounding compiles, and holds nothing.
        is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH.value
        sizes = model.geom_size[is_mesh & ((model.geom_contype | model.geom_conaffinity) != 0)]
        if not np.any(sizes.min(axis=1) <= _FLAT * sizes.max(axis=1)):
            return model, []
    except ValueError:
        pass  # the cause may be a flat mesh; other errors are raised again below
    caught.clear()
    boxed = []
    for mesh in list(spec.meshes):
        slab = _slab_of(mesh, made.get(mesh.name))
        if slab is None:
            continue
        geoms = [geom for geom in spec.geoms if geom.meshname == mesh.name]
        colliding = [geom for geom in geoms if geom.contype or geom.conaffinity]
        for geom in colliding:
            pose = from_quaternion(geom.pos, geom.quat) @ slab.pose
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_BOX, ""
            geom.size, geom.pos, geom.quat = slab.half_lengths, pose.position, pose.quaternion
            boxed.append((geom, slab))
        if len(colliding) < len(geoms):
            mesh.inertia = _SHELL
        else:
            made.pop(mesh.name, None)
            spec.delete(mesh)
    return spec.copy().compile(), boxed


def _slab_of(mesh: Any, triangles: Triangles | None) -> Slab | None:
    """A flat mesh as a box; ``None`` for other meshes.

    The box is behind the plane of the mesh, or around it where triangles show both sides.
    """
    try:
        model = _compile_alone(mesh, triangles, is_shown_only=True)
    except ValueError:
        return None
    # MuJoCo moves a mesh to its centre of mass, and turns it to its principal axes.
    moved = from_quaternion(model.mesh_pos[0], model.mesh_quat[0])
    vertices = model.mesh_vert @ moved.rotation.T + moved.position
    corners = vertices[model.mesh_face]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front, centre = normals.sum(axis=0), vertices.mean(axis=0)
    axes = np.linalg.svd(vertices - centre, full_matrices=False)[2]
    if axes[2] @ front < 0:
        axes[2] = -axes[2]
    axes[1] = np.cross(axes[2], axes[0])
    along, across, up = axes @ (vertices - centre).T
    if np.ptp(up) > _FLAT * np.ptp(along):
        return None
    turn, low, high, share = _rectangle(np.column_stack((along, across)))
    rotation = np.column_stack((axes[:2].T @ turn, axes[2]))
    sides = high - low
    thickness = min(_THICKNESS_M, float(sides.min()) / 10)
    is_one_sided = np.linalg.norm(front) > _FLAT * np.linalg.norm(normals, axis=1).sum()
    middle = np.append((low + high) / 2, -thickness / 2 if is_one_sided else 0.0)
    return Slab(
        np.append(sides, thickness) / 2,
        Pose(centre + rotation @ middle, rotation),
        share >= _RECTANGULAR,
    )


def _rectangle(points: Vector) -> tuple[Vector, Vector, Vector, float]:
    """The smallest rectangle around points, shape (n, 2): axes, corners, and filled share.

    One of its sides lies along an edge of the convex hull (Freeman and Shapira 1975).
    """
    hull = _convex_hull(points)
    edges = np.roll(hull, -1, axis=0) - hull
    x, y = (edges / np.linalg.norm(edges, axis=1, keepdims=True)).T
    turns = np.stack((np.column_stack((x, -y)), np.column_stack((y, x))), axis=1)  # (edge, 2, 2)
    placed = hull @ turns  # along every edge and across it: (edge, corner, 2)
    low, high = placed.min(axis=1), placed.max(axis=1)
    areas = np.prod(high - low, axis=1)
    best = int(areas.argmin())
    following = np.roll(hull, -1, axis=0)
    area = abs(np.sum(hull[:, 0] * following[:, 1] - hull[:, 1] * following[:, 0])) / 2
    return turns[best], low[best], high[best], float(area / areas[best])


def _convex_hull(points: Vector) -> Vector:
    """The corners of the hull in their order, shape (n, 2) (Andrew's monotone chain)."""
    ordered = sorted(set(map(tuple, points.tolist())))
    corners: list[tuple[float, float]] = []
    for way in (ordered, ordered[::-1]):
        chain: list[tuple[float, float]] = []
        for x, y in way:
            while len(chain) > 1:
                (ax, ay), (bx, by) = chain[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                chain.pop()
            chain.append((x, y))
        corners += chain[:-1]
    return np.array(corners)
