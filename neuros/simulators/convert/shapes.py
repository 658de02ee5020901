"""Collisions and visuals of SDF as geoms of MuJoCo, with their colours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from neuros.simulators.convert.building import Building, put
from neuros.simulators.convert.elements import Element
from neuros.simulators.convert.report import Report
from neuros.simulators.convert.scopes import Link
from neuros.simulators.convert.values import (
    Pose,
    from_quaternion,
    is_true,
    number,
    turning_z_to,
    vector,
)

_VISUAL_GROUP, _COLLISION_GROUP = 2, 3  # MuJoCo shows groups 0 to 2 unless told otherwise
_TYPES = mujoco.mjtGeom
_ALL_MASKS = 0xFFFF  # what Gazebo gives a collision that names none
_GREY = (0.7, 0.7, 0.7, 1.0)
# The diffuse colours of Gazebo's own materials, as far as a colour is all that they are.
_SCRIPTS: Mapping[str, tuple[float, float, float]] = {
    "Gazebo/Black": (0, 0, 0),
    "Gazebo/Blue": (0, 0, 1),
    "Gazebo/DarkGray": (0.175, 0.175, 0.175),
    "Gazebo/DarkGrey": (0.175, 0.175, 0.175),
    "Gazebo/FlatBlack": (0.1, 0.1, 0.1),
    "Gazebo/Gray": (0.7, 0.7, 0.7),
    "Gazebo/Green": (0, 1, 0),
    "Gazebo/Grey": (0.7, 0.7, 0.7),
    "Gazebo/Indigo": (0.33, 0, 0.5),
    "Gazebo/Orange": (1, 0.5088, 0.0468),
    "Gazebo/Purple": (1, 0, 1),
    "Gazebo/Red": (1, 0, 0),
    "Gazebo/Turquoise": (0, 1, 1),
    "Gazebo/White": (1, 1, 1),
    "Gazebo/Yellow": (1, 1, 0),
}


@dataclass
class Shape:
    """A geometry as MuJoCo takes it: half lengths in metres; ``pose`` is seen from its owner."""

    type: Any
    size: list[float] = field(default_factory=list)
    mesh: str = ""
    pose: Pose = field(default_factory=Pose)


def add_shapes(building: Building, link: Link, *, is_solid: bool) -> None:
    """Add the geoms of a link; the mass of a solid one is computed from its collisions."""
    for element in link.element.each("collision"):
        geom = _add(building, link, element, is_solid=is_solid)
        if geom is not None:
            geom.group = _COLLISION_GROUP
            _read_surface(building, element, geom)
            building.geoms[id(element)] = geom
            if is_solid:
                geom.density = number(element, "density", building.report, 1000.0, positive=True)
    for element in link.element.each("visual"):
        geom = _add(building, link, element, is_solid=False)
        if geom is not None:
            geom.group, geom.contype, geom.conaffinity, geom.mass = _VISUAL_GROUP, 0, 0, 0
            geom.rgba = _colour(element, building.report)


def share_masks(building: Building) -> None:
    """Give the geoms without a mask Gazebo's, once any geom has one of its own."""
    if building.masks:
        for key, geom in building.geoms.items():
            geom.contype = geom.conaffinity = building.masks.get(key, _ALL_MASKS)


def _add(building: Building, link: Link, element: Element, *, is_solid: bool) -> Any:
    shape = _read(building, element, is_solid=is_solid)
    if shape is None:
        return None
    if shape.type == _TYPES.mjGEOM_PLANE and not link.is_static:
        building.report.note(element, "MuJoCo has planes only where nothing moves")
        return None
    geom = building.body(link).add_geom(type=shape.type)
    geom.size[: len(shape.size)] = shape.size
    if shape.mesh:
        geom.meshname = shape.mesh
    pose = link.scope.read_pose(element, link.pose)
    put(geom, pose @ shape.pose, link.pose)
    noting = element if element.tag == "collision" else None  # visuals are not looked up by name
    geom.name = building.name("geom", f"{link.name}/{element.name}", noting)
    mesh = element.child("geometry", "mesh")
    if shape.mesh and mesh is not None and element.tag == "collision":
        building.colliding_meshes[geom.name] = mesh
    return geom


def _read(building: Building, owner: Element, *, is_solid: bool) -> Shape | None:
    report = building.report
    geometry = owner.child("geometry")
    if geometry is None:
        report.problem(owner, "<geometry> is missing")
        return None
    element = next(iter(geometry.children), None)
    if element is None or element.tag == "empty":
        if element is not None:
            element.taken = True
        return None
    element.taken = True

    def positive(tag: str, default: float) -> float:
        return number(element, tag, report, default, positive=True)

    match element.tag:
        case "box":
            return Shape(_TYPES.mjGEOM_BOX, _halves(building, element, (1, 1, 1)))
        case "sphere":
            return Shape(_TYPES.mjGEOM_SPHERE, [positive("radius", 1)])
        case "cylinder" | "capsule" as kind:
            size = [positive("radius", 0.5), positive("length", 1) / 2]
            is_capsule = kind == "capsule"
            return Shape(_TYPES.mjGEOM_CAPSULE if is_capsule else _TYPES.mjGEOM_CYLINDER, size)
        case "ellipsoid":
            radii = vector(element, "radii", report, (1.0, 1.0, 1.0))
            return Shape(_TYPES.mjGEOM_ELLIPSOID, _all_positive(building, element, radii))
        case "plane":
            return _plane(building, element)
        case "mesh":
            return _mesh(building, owner, element, is_solid=is_solid)
    report.note(element, f"MuJoCo has no geom for a <{element.tag}>")
    return None


def _halves(building: Building, element: Element, default: tuple[float, ...]) -> list[float]:
    size = vector(element, "size", building.report, default)
    return [length / 2 for length in _all_positive(building, element, size)]


def _all_positive(building: Building, element: Element, sizes: tuple[float, ...]) -> list[float]:
    if min(sizes) > 0:
        return list(sizes)
    building.report.problem(element, "every size must be positive")
    return [1.0] * len(sizes)


def _plane(building: Building, element: Element) -> Shape | None:
    normal = np.array(vector(element, "normal", building.report, (0.0, 0.0, 1.0)))
    if not normal.any():
        building.report.problem(element, "the normal is zero")
        return None
    size = _halves(building, element, (1, 1))
    turned = from_quaternion((0, 0, 0), turning_z_to(normal))
    return Shape(_TYPES.mjGEOM_PLANE, [*size, 1.0], pose=turned)


def _mesh(building: Building, owner: Element, element: Element, *, is_solid: bool) -> Shape | None:
    uri = element.child("uri")
    if uri is None or not uri.text:
        building.report.problem(element, "<uri> is missing: which file is the mesh in?")
        return None
    scale = vector(element, "scale", building.report, (1.0, 1.0, 1.0))
    is_needed = owner.tag == "collision"
    name = building.meshes.add(uri, scale, is_solid=is_solid, is_needed=is_needed)
    return None if name is None else Shape(_TYPES.mjGEOM_MESH, mesh=name)


def _read_surface(building: Building, collision: Element, geom: Any) -> None:
    surface = collision.child("surface")
    if surface is None:
        return
    report = building.report
    friction = surface.child("friction", "ode")
    if friction is not None:
        along = number(friction, "mu", report, 1.0)
        across = number(friction, "mu2", report, along)
        geom.friction[0] = min(along, 1e6)
        if across != along:
            report.remark(friction, f"MuJoCo's friction is {along:g} in every direction")
    contact = surface.child("contact")
    if contact is None:
        return
    if is_true(contact, "collide_without_contact", report, default=False):
        report.remark(
            contact, "it pushes what it touches: MuJoCo's contacts are felt by their force"
        )
    mask = contact.child("collide_bitmask")
    if mask is not None:
        try:
            building.masks[id(collision)] = int(mask.text, 0) & 0x7FFFFFFF
        except ValueError:
            report.problem(mask, f"'{mask.text}' is not a whole number")


def _colour(visual: Element, report: Report) -> tuple[float, ...]:
    """Red, green, blue and opacity of a visual, each from 0 to 1."""
    opacity = 1.0 - number(visual, "transparency", report, 0.0)
    material = visual.child("material")
    red, green, blue, alpha = _GREY if material is None else _diffuse(material, report)
    return (red, green, blue, alpha * opacity)


def _diffuse(material: Element, report: Report) -> tuple[float, ...]:
    script = material.child("script")
    name = None if script is None else script.child("name")
    base = _GREY
    if script is not None:
        if name is not None and name.text in _SCRIPTS:
            script.take_all()
            base = (*_SCRIPTS[name.text], 1.0)
        else:
            report.note(script, "a material script of Gazebo's")
    element = material.child("diffuse")
    if element is None:
        return base
    values = [float(word) for word in element.text.split() if _is_number(word)]
    if len(values) not in (3, 4) or len(values) != len(element.text.split()):
        report.problem(element, "a colour is red, green, blue and opacity, each from 0 to 1")
        return base
    return (*values, 1.0)[:4]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def light_colour(owner: Element, tag: str, report: Report, default: float) -> tuple[float, ...]:
    """Red, green and blue of a light."""
    element = owner.child(tag)
    if element is None:
        return (default,) * 3
    if len(element.text.split()) == 3:
        return vector(owner, tag, report, (default,) * 3)
    return vector(owner, tag, report, (default,) * 3 + (1.0,))[:3]
