"""Flat meshes, a floor or a wall of two triangles say: a thin box collides in the place of each.

MuJoCo collides the convex hull of a mesh, and a flat mesh has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from neuros.convert.meshes import SHELL, Triangles, compile_alone
from neuros.convert.poses import Pose, Vector, from_quaternion

_FLAT = 1e-4  # how thick, at most, by how long
_THICKNESS_M = 0.01
_RECTANGULAR = 0.999  # of its area, at least


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


def has_flat_meshes(model: Any) -> bool:
    """Whether a mesh collides that is flat but for rounding: it compiles, and holds nothing."""
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH.value
    sizes = model.geom_size[is_mesh & ((model.geom_contype | model.geom_conaffinity) != 0)]
    return bool(np.any(sizes.min(axis=1) <= _FLAT * sizes.max(axis=1)))


def box_flat_meshes(spec: Any, made: dict[str, Triangles]) -> list[tuple[Any, Slab]]:
    """Turn the colliding geoms of flat meshes into boxes, in a spec that was never compiled.

    ``made`` are the triangles of meshes that have no file. Returns the geoms; those that only show
    a flat mesh stay as they are.
    """
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
            mesh.inertia = SHELL
        else:
            made.pop(mesh.name, None)
            spec.delete(mesh) if hasattr(spec, "delete") else mesh.delete()  # until MuJoCo 3.3
    return boxed


def _slab_of(mesh: Any, triangles: Triangles | None) -> Slab | None:
    """``None`` where a mesh is not flat, or is at fault in another way."""
    try:
        model = compile_alone(mesh, triangles, is_shown_only=True)
    except ValueError:
        return None
    # MuJoCo moves a mesh to its centre of mass, and turns it to its principal axes.
    moved = from_quaternion(model.mesh_pos[0], model.mesh_quat[0])
    vertices = model.mesh_vert @ moved.rotation.T + moved.position
    corners = vertices[model.mesh_face]
    return _fit(vertices, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def _fit(vertices: Vector, normals: Vector) -> Slab | None:
    """The slab behind the plane of ``vertices``, or around it where triangles show both sides."""
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
    """The smallest rectangle around points, shape (n, 2): axes, corners, and how full it is.

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
    """Its corners in their order, shape (n, 2) (Andrew's monotone chain)."""
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
