"""Joints of SDF as joints, equality constraints and actuators of MuJoCo."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from neuros.simulators.convert.building import Building, set_first
from neuros.simulators.convert.elements import Element
from neuros.simulators.convert.report import Report
from neuros.simulators.convert.scopes import Scope
from neuros.simulators.convert.tree import Branch, Joint
from neuros.simulators.convert.values import Pose, Vector, is_true, number, text_of, vector

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
_HALF_HINGE_M = 0.05
_SOFT = "closes a loop: a soft constraint in MuJoCo, not a joint"
_CONNECT = mujoco.mjtEq.mjEQ_CONNECT
_WELD = mujoco.mjtEq.mjEQ_WELD
_POSITION, _VELOCITY = "JointPositionController", "JointController"
_STIFF_GAIN = 1000.0


@dataclass(frozen=True, eq=False)
class _Axis:
    """An axis of a joint: its direction in the world (unit length), and what limits it."""

    element: Element | None
    direction: Vector


def anchor(joint: Joint) -> Pose:
    """The pose of a joint in the world."""
    scope = joint.scope
    return scope.pose @ scope.place(joint.element.name, joint.element)


def _read_axis(joint: Joint, tag: str, report: Report) -> _Axis:
    """An axis in the world."""
    element = joint.element.child(tag)
    if element is None:
        if joint.type not in ("fixed", "ball") and tag == "axis2":
            report.problem(joint.element, f"a {joint.type} joint needs an <axis2>")
        return _Axis(None, anchor(joint).rotation @ np.array([0.0, 0.0, 1.0]))
    xyz = element.child("xyz")
    direction = np.array(vector(element, "xyz", report, (0.0, 0.0, 1.0)))
    length = np.linalg.norm(direction)
    if not length:
        report.problem(xyz or element, "the axis has no direction: its length is zero")
        return _Axis(element, np.array([0.0, 0.0, 1.0]))
    frame = _frame_of_axis(joint, element, xyz, report)
    return _Axis(element, frame.rotation @ (direction / length))


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
        axis = _read_axis(joint, tag, building.report) if tag else None
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
        _couple_screw(building, joint, names)
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


def _couple_screw(building: Building, joint: Joint, names: list[str]) -> None:
    """A screw is a hinge and a slide of which the one follows the other."""
    report, element = building.report, joint.element
    pitch = number(element, "screw_thread_pitch", report, 0.0)
    if element.child("screw_thread_pitch") is None:
        # The old one: radians per metre, left-handed.
        old = number(element, "thread_pitch", report, 1.0)
        pitch = -2 * math.pi / old if old else 0.0
    turn = next(name for name in names if name.endswith("/turn"))
    slide = next(name for name in names if name.endswith("/slide"))
    _follow(building, slide, turn, 0.0, pitch / (2 * math.pi))
    report.remark(
        element, "a screw is a hinge and a slide, held together by a soft constraint in MuJoCo"
    )


def _follow(building: Building, joint: str, leader: str, offset: float, ratio: float) -> None:
    """Let the position of one joint be ``offset`` + ``ratio`` times that of another."""
    equality = follow_joint(building.spec, joint, leader, offset, ratio)
    equality.name = building.name("equality", f"{joint} follows {leader}", None)


def follow_joint(spec: Any, joint: str, leader: str, offset: float, ratio: float) -> Any:
    """Add the constraint to a spec, without a name of its own; returns it."""
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
            leader = mimic.attributes.get("joint") or text_of(mimic, "joint")
            mine = building.joints.get(inner.prefix + element.name, [])
            theirs = building.joints.get(inner.prefix + leader.replace("::", "/"), [])
            if len(mine) != 1 or len(theirs) != 1:
                report.note(mimic, f"'{leader}' and this joint must have one axis each for MuJoCo")
                continue
            ratio = number(mimic, "multiplier", report, 1.0)
            offset = number(mimic, "offset", report, 0.0)
            reference = number(mimic, "reference", report, 0.0)
            _follow(building, mine[0], theirs[0], offset - ratio * reference, ratio)


def close_loop(building: Building, joint: Joint) -> None:
    """Constrain two bodies whose joint would close a loop: MuJoCo's bodies form a tree."""
    report = building.report
    place = anchor(joint)
    if joint.type == "fixed":
        _hold(building, joint, _WELD, place.position, "")
    elif joint.type in ("revolute", "continuous"):
        # Held at two points of its axis, it can turn about nothing else.
        direction = _read_axis(joint, "axis", report).direction
        for end, name in ((-_HALF_HINGE_M, "/1"), (_HALF_HINGE_M, "/2")):
            _hold(building, joint, _CONNECT, place.position + end * direction, name)
    elif joint.type == "ball":
        _hold(building, joint, _CONNECT, place.position, "")
    elif joint.type == "universal":
        _hold(building, joint, _CONNECT, place.position, "")
        report.note(joint.element, f"{_SOFT}; it may turn about the third axis, too")
        return
    else:
        report.note(joint.element, f"closes a loop, and MuJoCo has no {joint.type} constraint")
        return
    report.note(joint.element, f"{_SOFT}: without limits, friction and damping")


def _hold(building: Building, joint: Joint, kind: object, point: Vector, suffix: str) -> None:
    first, second = joint.child or joint.parent, joint.parent if joint.child else None
    equality = building.spec.add_equality(type=kind)
    equality.objtype = mujoco.mjtObj.mjOBJ_BODY
    equality.name = building.name("equality", joint.name + suffix, joint.element)
    equality.name1 = building.body(first).name
    equality.name2 = building.body(second).name if second else "world"
    data = np.zeros(len(equality.data))
    if kind == _CONNECT and first is not None:
        data[:3] = first.pose.inverse().rotation @ (point - first.pose.position)
    elif kind == _WELD:
        data[10] = 1.0  # as much against turning as against moving; the pose is the present one
    equality.data = data


def add_actuators(building: Building, scope: Scope) -> None:
    """An actuator for every joint controller of Gazebo's in a model and those in it.

    ``JointPositionController`` is a PD controller, which is a ``position`` actuator;
    ``JointController`` holds a velocity, which is a ``velocity`` actuator. Every other plugin is
    code that runs inside Gazebo, and is listed.
    """
    for inner, plugin in _controllers(scope):
        kind = plugin.name.rpartition("::")[2]
        names = [element.text for element in plugin.each("joint_name")]
        if not names:
            building.report.problem(plugin, "<joint_name> is missing: which joint is driven?")
        for name in names:
            joints = building.joints.get(inner.prefix + name.replace("::", "/"), [])
            if len(joints) != 1:
                building.report.problem(plugin, f"there is no joint with one axis called '{name}'")
                continue
            actuator = building.spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.name = building.name("actuator", joints[0], plugin)
            actuator.target = joints[0]
            _set_gains(actuator, plugin, kind, building.report)
        _note_the_rest(plugin, building.report)


def _controllers(scope: Scope) -> list[tuple[Scope, Element]]:
    return [
        (inner, plugin)
        for inner in scope.and_models()
        for plugin in inner.element.children
        if plugin.tag == "plugin" and plugin.name.rpartition("::")[2] in (_POSITION, _VELOCITY)
    ]


def _set_gains(actuator: Any, plugin: Element, kind: str, report: Report) -> None:
    plugin.taken = True
    gain = number(plugin, "p_gain", report, 1.0 if kind == _POSITION else _STIFF_GAIN)
    if kind == _POSITION:
        actuator.set_to_position(kp=gain, kv=max(0.0, number(plugin, "d_gain", report, 0.1)))
    else:
        if text_of(plugin, "use_force_commands") not in ("true", "1"):
            report.remark(plugin, "Gazebo sets the velocity; here a gain (kv) holds it")
        actuator.set_to_velocity(kv=gain)
    least = number(plugin, "cmd_min", report, -math.inf)
    most = number(plugin, "cmd_max", report, math.inf)
    if least < most and not (math.isinf(least) and math.isinf(most)):
        actuator.forcerange, actuator.forcelimited = [max(least, -1e15), min(most, 1e15)], True


def _note_the_rest(plugin: Element, report: Report) -> None:
    if number(plugin, "i_gain", report, 0.0) == 0:
        for tag in ("i_gain", "i_max", "i_min"):
            plugin.child(tag)
    else:
        report.remark(plugin, "without the integral part: MuJoCo's servos have P and D")
    if plugin.name.endswith(f"::{_VELOCITY}") and number(plugin, "d_gain", report, 0.0) == 0:
        plugin.child("d_gain")
    if number(plugin, "cmd_offset", report, 0.0) == 0:
        plugin.child("cmd_offset")
