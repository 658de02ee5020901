"""Joints: from SDF's to one or more of MuJoCo's on the body of a link."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from neuros.convert.building import Building, set_first
from neuros.convert.elements import Element
from neuros.convert.numbers import is_true, number, vector, word
from neuros.convert.poses import Pose, Vector
from neuros.convert.report import Report
from neuros.convert.scopes import Scope
from neuros.convert.tree import Branch, Joint

_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_BALL = mujoco.mjtJoint.mjJNT_BALL
_NO_LIMIT = 1e15
_UNLIMITED_ENDS = (-1e16, 1e16)

# The kinds of joints in MuJoCo that each type consists of, by the element with its axis.
_PARTS: dict[str, tuple[tuple[Any, str], ...]] = {
    "revolute": ((_HINGE, "axis"),),
    "continuous": ((_HINGE, "axis"),),
    "prismatic": ((_SLIDE, "axis"),),
    "universal": ((_HINGE, "axis"), (_HINGE, "axis2")),
    "revolute2": ((_HINGE, "axis"), (_HINGE, "axis2")),
    "screw": ((_HINGE, "axis"), (_SLIDE, "axis")),
    "gearbox": ((_HINGE, "axis"),),
    "ball": ((_BALL, ""),),
    "fixed": (),
}


@dataclass(frozen=True, eq=False)
class Axis:
    """An axis of a joint: its direction in the world (unit length), and what limits it."""

    element: Element | None
    direction: Vector


def anchor(joint: Joint) -> Pose:
    """Where a joint is, in the world."""
    scope = joint.scope
    return scope.pose @ scope.place(joint.element.name, joint.element)


def is_known(joint: Joint, report: Report) -> bool:
    """Whether there is such a type of joint; a problem is reported."""
    if joint.type in _PARTS:
        return True
    known = ", ".join(sorted(_PARTS))
    report.problem(joint.element, f"'{joint.type}' is not a type of joint", f"there are: {known}")
    return False


def add_joints(building: Building, branch: Branch) -> None:
    """Add the joints between a body and the one that it hangs on."""
    joint = branch.joint
    if joint is None or joint.type not in _PARTS:
        return
    body = building.body(branch.link)
    place = branch.link.pose.inverse() @ anchor(joint)
    parts = _PARTS[joint.type]
    names = []
    # MuJoCo moves a body by its joints in their order, the first one hangs on the parent.
    for kind, tag in reversed(parts) if branch.is_turned else parts:
        axis = read_axis(joint, tag, building.report) if tag else None
        made = body.add_joint(type=kind, pos=place.position)
        suffix = f"/{tag}" if len(parts) > 1 else ""
        if joint.type == "screw":
            suffix = "/turn" if kind == _HINGE else "/slide"
        made.name = building.name("joint", joint.name + suffix, joint.element)
        names.append(made.name)
        if axis is not None:
            direction = branch.link.pose.rotation.T @ axis.direction
            made.axis = -direction if branch.is_turned else direction
            if axis.element is not None and not (joint.type == "screw" and kind == _SLIDE):
                _read_dynamics(axis.element, made, joint.type, building.report)
    building.joints[joint.name] = names
    if joint.type == "screw":
        _couple(building, joint, names)
    if joint.type == "gearbox":
        building.report.remark(joint.element, "a gearbox is a hinge without its gears in MuJoCo")


def read_axis(joint: Joint, tag: str, report: Report) -> Axis:
    """An axis in the world."""
    element = joint.element.child(tag)
    if element is None:
        if joint.type not in ("fixed", "ball") and tag == "axis2":
            report.problem(joint.element, f"a {joint.type} joint needs an <axis2>")
        return Axis(None, anchor(joint).rotation @ np.array([0.0, 0.0, 1.0]))
    xyz = element.child("xyz")
    direction = np.array(vector(element, "xyz", report, (0.0, 0.0, 1.0)))
    length = np.linalg.norm(direction)
    if not length:
        report.problem(xyz or element, "the axis has no direction: its length is zero")
        return Axis(element, np.array([0.0, 0.0, 1.0]))
    frame = _frame_of_axis(joint, element, xyz, report)
    return Axis(element, frame.rotation @ (direction / length))


def _frame_of_axis(joint: Joint, axis: Element, xyz: Element | None, report: Report) -> Pose:
    """The frame that an axis is written in."""
    scope, named = joint.scope, ""
    if xyz is not None:
        named = xyz.attributes.get("expressed_in", "")
    if is_true(axis, "use_parent_model_frame", report, default=_is_old(scope)):
        named = named or "__model__"
    if named:
        return scope.pose @ scope.place(named, axis)
    return anchor(joint)


def _is_old(scope: Scope) -> bool:
    """Whether axes are in the frame of the model, as they were until SDF 1.4."""
    for element in scope.element.and_ancestors():
        version = element.attributes.get("_version") or (
            element.attributes.get("version", "") if element.tag == "sdf" else ""
        )
        if version:
            numbers = version.split(".")
            return numbers[0] == "1" and len(numbers) > 1 and numbers[1] in "01234"
    return False


def _read_dynamics(axis: Element, joint: Any, joint_type: str, report: Report) -> None:
    limit = axis.child("limit")
    if limit is not None:
        lower = number(limit, "lower", report, _UNLIMITED_ENDS[0])
        upper = number(limit, "upper", report, _UNLIMITED_ENDS[1])
        if lower > upper:
            report.problem(limit, f"the lower limit {lower:g} is above the upper one, {upper:g}")
        elif joint_type != "continuous" and (lower > -_NO_LIMIT or upper < _NO_LIMIT):
            _set_range(joint, max(lower, -_NO_LIMIT), min(upper, _NO_LIMIT))
        effort = number(limit, "effort", report, math.inf)
        if 0 < effort < _NO_LIMIT:
            joint.actfrcrange, joint.actfrclimited = [-effort, effort], True
        velocity = limit.child("velocity")
        if velocity is not None and not 0 <= number(limit, "velocity", report, -1) < _NO_LIMIT:
            velocity.take_all()
        elif velocity is not None:
            velocity.taken = False
    dynamics = axis.child("dynamics")
    if dynamics is not None:
        set_first(joint, "damping", number(dynamics, "damping", report, 0.0))
        joint.frictionloss = number(dynamics, "friction", report, 0.0)
        set_first(joint, "stiffness", number(dynamics, "spring_stiffness", report, 0.0))
        joint.springref = number(dynamics, "spring_reference", report, 0.0)


def _set_range(joint: Any, lower: float, upper: float) -> None:
    if lower == upper:
        upper = math.nextafter(lower, math.inf)  # MuJoCo takes no empty range
    joint.range, joint.limited = [lower, upper], True


def _couple(building: Building, joint: Joint, names: list[str]) -> None:
    """A screw is a hinge and a slide of which the one follows the other."""
    report, element = building.report, joint.element
    pitch = number(element, "screw_thread_pitch", report, 0.0)
    if element.child("screw_thread_pitch") is None:
        # The old one: radians per metre, left-handed.
        old = number(element, "thread_pitch", report, 1.0)
        pitch = -2 * math.pi / old if old else 0.0
    turn = next(name for name in names if name.endswith("/turn"))
    slide = next(name for name in names if name.endswith("/slide"))
    follow(building, slide, turn, 0.0, pitch / (2 * math.pi))
    report.remark(
        element, "a screw is a hinge and a slide, held together by a soft constraint in MuJoCo"
    )


def follow(building: Building, joint: str, leader: str, offset: float, ratio: float) -> None:
    """Let the position of one joint be ``offset`` + ``ratio`` times that of another."""
    equality = follow_joint(building.spec, joint, leader, offset, ratio)
    equality.name = building.name("equality", f"{joint} follows {leader}", None)


def follow_joint(spec: Any, joint: str, leader: str, offset: float, ratio: float) -> Any:
    """The same in a spec; returns the constraint."""
    equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT)
    equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
    equality.name1, equality.name2 = joint, leader
    data = np.zeros(len(equality.data))
    data[:2] = offset, ratio
    equality.data = data
    return equality


def add_mimics(building: Building, scope: Scope) -> None:
    """``<mimic>`` of an axis: the joint follows another one (SDF 1.11)."""
    report = building.report
    for inner, element in scope.each("joint"):
        for tag in ("axis", "axis2"):
            mimic = element.child(tag, "mimic") if element.child(tag) else None
            if mimic is None:
                continue
            leader = mimic.attributes.get("joint") or word(mimic, "joint")
            mine = building.joints.get(inner.prefix + element.name, [])
            theirs = building.joints.get(inner.prefix + leader.replace("::", "/"), [])
            if len(mine) != 1 or len(theirs) != 1:
                report.note(mimic, f"'{leader}' and this joint must have one axis each for MuJoCo")
                continue
            ratio = number(mimic, "multiplier", report, 1.0)
            offset = number(mimic, "offset", report, 0.0)
            reference = number(mimic, "reference", report, 0.0)
            follow(building, mine[0], theirs[0], offset - ratio * reference, ratio)
