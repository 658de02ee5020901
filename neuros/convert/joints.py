"""Joints: from SDF's to one or more of MuJoCo's on the body of a link."""

from __future__ import annotations

import math
from typing import Any

import mujoco

from neuros.convert.axes import anchor, read_axis
from neuros.convert.building import Building, set_first
from neuros.convert.couplings import couple_screw
from neuros.convert.elements import Element
from neuros.convert.numbers import number
from neuros.convert.report import Report
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
        couple_screw(building, joint, names)
    if joint.type == "gearbox":
        building.report.remark(joint.element, "a gearbox is a hinge without its gears in MuJoCo")


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
