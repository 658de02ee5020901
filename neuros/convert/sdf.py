"""SDF (SDFormat 1.4 to 1.11) to an ``MjSpec``."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import mujoco

from neuros.convert.building import Building, put
from neuros.convert.controllers import add_actuators
from neuros.convert.converted import Converted
from neuros.convert.couplings import add_mimics
from neuros.convert.elements import Element
from neuros.convert.find import Finder
from neuros.convert.flat import box_flat_meshes, has_flat_meshes
from neuros.convert.includes import Includer
from neuros.convert.inertia import is_computed, read_inertia, set_inertia
from neuros.convert.joints import add_joints, is_known
from neuros.convert.loops import close_loop
from neuros.convert.meshes import Meshes
from neuros.convert.numbers import is_true, word
from neuros.convert.poses import Pose
from neuros.convert.report import Report
from neuros.convert.scope_reading import place_all, read_scope
from neuros.convert.scopes import Link, Scope
from neuros.convert.sensors import add_joint_sensors, add_link_sensors
from neuros.convert.shapes import add_shapes, share_masks
from neuros.convert.sites import add_frames
from neuros.convert.tree import Branch, Joint, Tree, grow
from neuros.convert.world import add_lights, read_world


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
    name = word(joint, side)
    if not name:
        report.problem(joint, f"<{side}> is missing: which link is the {side}?")
        return None
    return scope.body(name, joint.child(side) or joint)


def _build(building: Building, scope: Scope, tree: Tree) -> None:
    if scope.element.tag == "world":
        read_world(building, scope)
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
    add_lights(building, scope)
    _exclude_contacts(building, scope)


def _add_body(building: Building, branch: Branch) -> None:
    link, report = branch.link, building.report
    body = building.body(branch.parent).add_body()
    building.bodies[id(link)] = body
    body.name = building.name("body", link.name, link.element)
    put(body, link.pose, Pose() if branch.parent is None else branch.parent.pose)
    is_solid = is_computed(link.element) and not link.is_static
    if link.is_static:
        inertial = link.element.child("inertial")
        if inertial is not None:
            inertial.take_all()  # what never moves needs none
    elif not is_solid:
        set_inertia(body, read_inertia(link.element, report))
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
