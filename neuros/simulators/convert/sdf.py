"""SDF (SDFormat 1.4 to 1.11) to an ``MjSpec``."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from neuros.simulators.convert.building import Building, put
from neuros.simulators.convert.elements import Element
from neuros.simulators.convert.find import Finder
from neuros.simulators.convert.includes import Includer
from neuros.simulators.convert.joints import (
    add_actuators,
    add_joints,
    add_mimics,
    close_loop,
    is_known,
)
from neuros.simulators.convert.meshes import Meshes, box_flat_meshes, has_flat_meshes
from neuros.simulators.convert.output import Converted
from neuros.simulators.convert.report import Report
from neuros.simulators.convert.scopes import Link, Scope, place_all, read_scope
from neuros.simulators.convert.sensors import add_frames, add_joint_sensors, add_link_sensors
from neuros.simulators.convert.shapes import add_shapes, light_colour, share_masks
from neuros.simulators.convert.tree import Branch, Joint, Tree, grow
from neuros.simulators.convert.values import (
    Pose,
    Vector,
    is_true,
    number,
    read_pose,
    text_of,
    vector,
)

_ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_DEFAULTS = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
_TOLERANCE = 1e-9
_GRAVITY = (0.0, 0.0, -9.8)
_MAGNETIC_FIELD_T = (5.5645e-6, 22.8758e-6, -42.3884e-6)
_TYPES = mujoco.mjtLightType
_LIGHTS = {
    "directional": _TYPES.mjLIGHT_DIRECTIONAL,
    "point": _TYPES.mjLIGHT_POINT,
    "spot": _TYPES.mjLIGHT_SPOT,
}


def convert_sdf(file: Path, finder: Finder) -> Converted:
    """Convert the world of an SDF file, or else its model; ``finder`` looks up what it names.

    Raises:
        DescriptionError: with everything that is wrong with the file and those that it includes.
    """
    report = Report()
    includer = Includer(finder, report)
    root = includer.read(file.resolve())
    if root is None:
        report.raise_any()
    assert root is not None
    scope = _read(root, report)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.modelname = (scope.element.name or next(iter(scope.models), "")) or "sdf"
    building = Building(spec, report, Meshes(spec, finder, report))
    tree = _grow(scope, report)
    _build(building, scope, tree)
    report.raise_any()
    model = _compiled(building, root)
    report.note_unread(includer.roots)
    made = building.meshes.made
    return Converted(spec, report.not_taken(), made, model.nbody - 1, model.njnt)


def _read(root: Element, report: Report) -> Scope:
    """The world in a file; a model without one stands in an empty world."""
    worlds = root.each("world")
    for other in worlds[1:]:
        report.note(other, "a file becomes one model: the first world counts")
    element = worlds[0] if worlds else root
    if worlds and not worlds[0].name:
        report.problem(worlds[0], "the <world> has no name")
    if not worlds and not root.each("model"):
        report.problem(root, "there is neither a <world> nor a <model> in it")
    scope = read_scope(element, report, parent=None)
    place_all(scope)
    return scope


def _grow(scope: Scope, report: Report) -> Tree:
    links = [link for inner in scope.and_models() for link in inner.links.values()]
    joints = []
    for inner, element in scope.each("joint"):
        ends = [_end(inner, element, side, report) for side in ("parent", "child")]
        joint = Joint(element, inner, *ends)
        if not is_known(joint, report) or element.name not in inner.frames:
            continue
        if all(end is None or end.is_static for end in ends):
            report.note(element, "between things that never move")
        elif ends[0] is ends[1]:
            report.problem(element, "joins a link to itself, or nothing that there is")
        else:
            joints.append(joint)
    return grow(links, joints)


def _end(scope: Scope, joint: Element, side: str, report: Report) -> Link | None:
    name = text_of(joint, side)
    if not name:
        report.problem(joint, f"<{side}> is missing: which link is the {side}?")
        return None
    return scope.body(name, joint.child(side) or joint)


def _build(building: Building, scope: Scope, tree: Tree) -> None:
    if scope.element.tag == "world":
        _read_world(building, scope)
    for branch in tree.branches:
        _add_body(building, branch)
    share_masks(building)
    for branch in tree.branches:
        add_joint_sensors(building, branch)
    for joint in tree.loops:
        close_loop(building, joint)
    add_mimics(building, scope)
    add_actuators(building, scope)
    add_frames(building, scope)
    _add_lights(building, scope)
    _exclude_contacts(building, scope)


def _add_body(building: Building, branch: Branch) -> None:
    link, report = branch.link, building.report
    body = building.body(branch.parent).add_body()
    building.bodies[id(link)] = body
    body.name = building.name("body", link.name, link.element)
    put(body, link.pose, Pose() if branch.parent is None else branch.parent.pose)
    is_solid = _is_computed(link.element) and not link.is_static
    if link.is_static:
        inertial = link.element.child("inertial")
        if inertial is not None:
            inertial.take_all()  # what never moves needs none
    elif not is_solid:
        _set_inertia(body, _read_inertia(link.element, report))
    if not is_true(link.element, "gravity", report, default=True):
        body.gravcomp = 1.0
    if branch.joint is not None:
        add_joints(building, branch)
    elif not link.is_static:
        free = body.add_freejoint()
        free.name = building.name("joint", f"{link.name}/free", link.element)
    add_shapes(building, link, is_solid=is_solid)
    add_link_sensors(building, link)


def _exclude_contacts(building: Building, scope: Scope) -> None:
    """Links of one model do not collide with each other, unless it says so."""
    groups: dict[int, list[str]] = {}
    for inner in scope.and_models():
        outer = inner.outermost
        if outer.self_collides or outer.is_static:
            continue
        groups.setdefault(id(outer), []).extend(
            building.body(link).name
            for link in inner.links.values()
            if any(id(child) in building.geoms for child in link.element.children)
        )
    for names in groups.values():
        for index, first in enumerate(names):
            for second in names[index + 1 :]:
                building.spec.add_exclude(bodyname1=first, bodyname2=second)


def _compiled(building: Building, root: Element) -> Any:
    try:
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            boxed = []
            try:
                model = building.spec.copy().compile()  # MuJoCo 3 forgets no mesh of a geom
                may_be_flat = has_flat_meshes(model)
            except ValueError:
                may_be_flat = True
            if may_be_flat:
                heard.clear()
                boxed = box_flat_meshes(building.spec, building.meshes.made)
                model = building.spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        building.meshes.blame()
        building.report.raise_any()
        text = " ".join(str(error).removeprefix("Error: ").split())
        building.report.problem(root, f"MuJoCo cannot compile what became of it: {text}")
        building.report.raise_any()
        raise
    why = {geom.name: str(slab) for geom, slab in boxed}
    for name, mesh in building.colliding_meshes.items():
        building.report.remark(mesh, why.get(name, "MuJoCo collides the convex hull of a mesh"))
    for warning in heard:
        building.report.remark(root, f"MuJoCo: {' '.join(str(warning.message).split())}")
    return model


@dataclass(frozen=True, eq=False)
class _Inertia:
    """Of a link, in its own frame.

    Attributes:
        mass: kg.
        centre: of mass, shape (3,), metres.
        matrix: about the centre of mass and along the link's axes, shape (3, 3), kg m².
    """

    mass: float
    centre: Vector
    matrix: Vector


def _is_computed(link: Element) -> bool:
    """Whether the mass is to be computed from shapes and densities (SDF 1.11)."""
    inertial = link.child("inertial")
    return inertial is not None and inertial.attributes.get("auto", "false") in ("true", "1")


def _read_inertia(link: Element, report: Report) -> _Inertia:
    """Read ``<inertial>``; SDF's defaults are 1 kg and 1 kg m²."""
    inertial = link.child("inertial")
    if inertial is None:
        report.remark(link, "no <inertial>: it gets SDF's 1 kg, and 1 kg m² about each axis")
        return _Inertia(1.0, np.zeros(3), np.eye(3))
    pose = read_pose(inertial, report)
    mass = number(inertial, "mass", report, 1.0, positive=True)
    values = dict(zip(_ENTRIES, _DEFAULTS, strict=True))
    element = inertial.child("inertia")
    if element is not None:
        values = {key: number(element, key, report, values[key]) for key in _ENTRIES}
    ixx, iyy, izz, ixy, ixz, iyz = values.values()
    matrix = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    matrix = _possible(matrix, element or inertial, report)
    return _Inertia(mass, pose.position, pose.rotation @ matrix @ pose.rotation.T)


def _set_inertia(body: Any, inertia: _Inertia) -> None:
    """Give it to a body of the spec."""
    matrix = inertia.matrix
    body.explicitinertial = True
    body.mass, body.ipos = inertia.mass, inertia.centre
    body.fullinertia = [*np.diag(matrix), matrix[0, 1], matrix[0, 2], matrix[1, 2]]


def _possible(matrix: Vector, element: Element, report: Report) -> Vector:
    """The matrix, or one that a rigid body can have."""
    if not np.isfinite(matrix).all():
        report.problem(element, "every moment of inertia must be finite")
        return np.eye(3)
    least, middle, most = np.linalg.eigvalsh(matrix)
    if least <= 0:
        report.problem(
            element,
            f"no body has this inertia: its principal moments are {least:.3g}, {middle:.3g} and"
            f" {most:.3g} kg m², and each must be positive",
        )
        return np.eye(3)
    if least + middle < most * (1 - _TOLERANCE):
        mean = float(np.trace(matrix)) / 3
        report.remark(
            element,
            f"no body has this inertia (its largest principal moment, {most:.3g} kg m², exceeds the"
            f" sum of the others): MuJoCo gets {mean:.3g} kg m² about every axis",
        )
        return np.eye(3) * mean
    return matrix


def _read_world(building: Building, scope: Scope) -> None:
    """Options of the whole model, from a ``<world>``, with SDF's defaults."""
    world, report, option = scope.element, building.report, building.spec.option
    option.gravity = vector(world, "gravity", report, _GRAVITY)
    option.magnetic = vector(world, "magnetic_field", report, _MAGNETIC_FIELD_T)
    engines = world.each("physics")
    for unused in engines[1:]:
        report.note(unused, "the first <physics> counts")
    if engines:
        option.timestep = number(engines[0], "max_step_size", report, 0.001, positive=True)
    else:
        option.timestep = 0.001


def _add_lights(building: Building, scope: Scope) -> None:
    """Lights of a world, of models and of links."""
    for inner in scope.and_models():
        for element in inner.element.each("light"):
            _add_light(building, element, inner.read_pose(element, inner.pose), None)
        for link in inner.links.values():
            for element in link.element.each("light"):
                _add_light(building, element, inner.read_pose(element, link.pose), link)


def _add_light(building: Building, element: Element, pose: Pose, link: Link | None) -> None:
    report, kind = building.report, element.attributes.get("type", "point")
    if kind not in _LIGHTS:
        report.problem(element, f"'{kind}' is not a light", f"there are: {', '.join(_LIGHTS)}")
        return
    seen_from = Pose() if link is None else link.pose
    local = seen_from.inverse() @ pose
    light: Any = building.body(link).add_light(pos=local.position, type=_LIGHTS[kind])
    light.name = building.name("light", element.name, element)
    direction = np.array(vector(element, "direction", report, (0.0, 0.0, -1.0)))
    if direction.any():
        light.dir = local.rotation @ (direction / np.linalg.norm(direction))
    light.diffuse = light_colour(element, "diffuse", report, 1.0)
    light.specular = light_colour(element, "specular", report, 0.1)
    light.castshadow = is_true(element, "cast_shadows", report, default=False)
    _read_attenuation(building, element, light)
    spot = element.child("spot")
    if spot is not None and kind == "spot":
        light.cutoff = math.degrees(number(spot, "outer_angle", report, 0.0)) or 45.0
        light.exponent = number(spot, "falloff", report, 0.0)


def _read_attenuation(building: Building, element: Element, light: Any) -> None:
    attenuation = element.child("attenuation")
    if attenuation is None:
        return
    names = ("constant", "linear", "quadratic")
    light.attenuation = [
        number(attenuation, name, building.report, default)
        for name, default in zip(names, (1.0, 0.0, 0.0), strict=True)
    ]
    light.range = number(attenuation, "range", building.report, 10.0, positive=True)
