"""Bodies of links in MuJoCo, with their joints, and constraints and actuators of joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from neuros_robots import links
from neuros_robots.elements import HUGE, Element
from neuros_robots.frames import Branch, Joint, Pose, Scope, Vector, read_pose
from neuros_robots.mjcf import Building

_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_BALL, _FREE = mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_FREE
_INERTIA = {"ixx": 1.0, "iyy": 1.0, "izz": 1.0, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
_TOLERANCE = 1e-9
_UNLIMITED_ENDS = (-1e16, 1e16)
_MOST_LINKS = 1000
# By type of joint: MuJoCo's joints that make it up, each with the element of its axis.
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
    # Those of URDF that SDF lacks; "carried" is a floating joint whose parent moves.
    "floating": ((_FREE, ""),),
    "carried": ((_SLIDE, "x"), (_SLIDE, "y"), (_SLIDE, "z"), (_BALL, "turn")),
    "planar": ((_SLIDE, "x"), (_SLIDE, "y"), (_HINGE, "turn")),
    "spherical": ((_BALL, ""),),  # Bullet's
}
URDF_TYPES = ("continuous", "fixed", "floating", "planar", "prismatic", "revolute", "spherical")
SDF_TYPES = tuple(sorted({*_PARTS} - {"floating", "carried", "planar", "spherical"}))
# What MuJoCo requires of a moving body without mass, which it then has beside all others.
_LEAST_KG = _LEAST_KG_M2 = 1e-9
_LEAST_GYRATION_M2 = 1e-6  # of a mass in one point: that of a ball of some millimetres
_LOCKED = 1e-9, 2e-5  # absolute and relative width of an empty range; six digits show it
_HALF_HINGE_M = 0.05
_SOFT = "closes a loop: a soft constraint in MuJoCo, not a joint"
_CONNECT = mujoco.mjtEq.mjEQ_CONNECT
_WELD = mujoco.mjtEq.mjEQ_WELD
_POSITION, _VELOCITY = "JointPositionController", "JointController"
_STIFF_GAIN = 1000.0


def add_tree(building: Building, scope: Scope, branches: Sequence[Branch]) -> None:
    """Add the bodies of links, with all that belongs to them, and what holds between them."""
    for branch in branches:
        _add_body(building, branch)
    _give_least_masses(building, branches)
    links.share_masks(building)
    for branch in branches:
        if branch.joint is not None:
            links.add_joint_sensors(building, branch.link, branch.joint, is_turned=branch.is_turned)
    _add_mimics(building, scope)
    _exclude_contacts(building, scope)


def _add_body(building: Building, branch: Branch) -> None:
    """Add the body of a link with its inertia, joints, shapes and sensors."""
    link, inertial = branch.link, branch.link.element.child("inertial")
    body = building.add("body", branch.parent, link.pose, link.name, link.element)
    building.bodies[id(link)] = body
    # Since SDF 1.11 the mass may be computed from shapes and densities.
    is_solid = inertial is not None and inertial.has("auto") and not link.is_static
    if not link.is_static and not is_solid:
        _set_inertia(body, link.element, inertial)
    elif link.is_static:
        body.explicitinertial = True  # no mass, rather than one that MuJoCo computes of its shapes
        if inertial is not None:
            inertial.mark_all_read()
    if not link.element.is_true("gravity", default=True):
        body.gravcomp = 1.0
    if branch.joint is not None:
        _add_joints(building, branch, branch.joint)
    elif not link.is_static:
        free = body.add_freejoint()
        free.name = building.name("joint", f"{link.name}/free", link.element)
    links.add_shapes(building, link, is_solid=is_solid)
    links.add_link_sensors(building, link)


def _set_inertia(body: Any, link: Element, inertial: Element | None) -> None:
    """Set mass (kg), its centre (m) and inertia (kg m²); SDF's defaults are 1 kg and 1 kg m²."""
    mass, centre, matrix = 1.0, np.zeros(3), np.eye(3)
    if inertial is None:
        link.remark("no <inertial>: it gets SDF's 1 kg, and 1 kg m² about each axis")
    else:
        pose = read_pose(inertial)
        mass, centre = inertial.number("mass", 1.0), pose.position
        if not 0 <= mass < HUGE:
            (inertial.child("mass") or inertial).problem(f"must be a positive number, not {mass:g}")
        element = inertial.child("inertia") or inertial.made("inertia")
        ixx, iyy, izz, ixy, ixz, iyz = (element.number(*entry) for entry in _INERTIA.items())
        matrix = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        matrix = pose.rotation @ _possible(matrix, mass, element) @ pose.rotation.T
    body.ipos = centre
    # Set mass and inertia; not as a full matrix, of which MuJoCo refuses moments below 1e-14.
    body.explicitinertial = True
    body.mass = mass
    moments, axes = np.linalg.eigh(matrix)
    if np.count_nonzero(matrix - np.diag(np.diag(matrix))):
        axes[:, 2] *= np.sign(np.linalg.det(axes))  # right-handed
        body.inertia, body.iquat = moments, Pose(rotation=axes).quaternion
    else:
        body.inertia, body.iquat = np.diag(matrix), [1, 0, 0, 0]


def _possible(matrix: Vector, mass: float, element: Element) -> Vector:
    """The matrix, or a replacement if no rigid body has this inertia."""
    if not (np.abs(matrix) < HUGE).all():
        element.problem(f"every moment of inertia must be finite, and below {HUGE:g}")
        return np.eye(3)
    if np.abs(matrix).max() < mujoco.mjMINVAL:  # rounded
        matrix = np.zeros((3, 3))
    moments, axes = np.linalg.eigh(matrix)
    least, middle, most = moments
    if np.diag(matrix).min() < 0 or most < 0:
        element.problem(
            f"no body has this inertia: its principal moments are {least:.3g}, {middle:.3g} and"
            f" {most:.3g} kg m², and each must be positive",
        )
        return np.eye(3)
    if least >= -_TOLERANCE * most and least + middle >= most * (1 - _TOLERANCE):
        if least > _TOLERANCE * most or (not mass and not most):
            return matrix
        # A rod or a point, which MuJoCo takes with a little thickness only.
        thin = min(mass * _LEAST_GYRATION_M2, most or math.inf)
        element.remark(
            f"the body is a {'rod' if most else 'point'} (it has a principal moment of 0): MuJoCo"
            f" gets {thin:.3g} kg m² there"
        )
        thicker: Vector = axes @ np.diag(np.maximum(moments, thin)) @ axes.T
        return thicker
    mean = float(np.trace(matrix)) / 3
    why = f"its largest principal moment, {most:.3g} kg m², exceeds the sum of the others"
    if least < 0:
        why = f"its smallest principal moment is {least:.3g} kg m²"
    element.remark(
        f"no body has this inertia ({why}): MuJoCo gets {mean:.3g} kg m² about every axis"
    )
    return np.eye(3) * mean


def _give_least_masses(building: Building, branches: Sequence[Branch]) -> None:
    """Give moving bodies without mass what MuJoCo requires, and name their links.

    A body counts with those that are fixed to it.
    """
    tops: dict[int, Branch] = {}  # by link: the body that it is rigidly joined to, nearest the root
    heavy = set[int]()
    for branch in branches:
        top = branch
        if branch.joint is not None and not _PARTS[branch.joint.type] and branch.parent is not None:
            top = tops.get(id(branch.parent), branch)  # the link may be the world
        tops[id(branch.link)] = top
        if _is_heavy(building.body(branch.link)):
            heavy.add(id(top.link))
    for branch in branches:
        is_moving = branch.joint is None or bool(_PARTS[branch.joint.type])
        if not is_moving or branch.link.is_static or id(branch.link) in heavy:
            continue
        body = building.body(branch.link)
        body.mass = max(body.mass, _LEAST_KG)
        body.inertia = body.inertia + _LEAST_KG_M2
        branch.link.element.remark(
            f"'{branch.link.name}' moves, and has no mass or no inertia: MuJoCo gets {_LEAST_KG:g}"
            f" kg and {_LEAST_KG_M2:g} kg m²; give it an <inertial>"
        )


def _is_heavy(body: Any) -> bool:
    """Whether mass and inertia of a body suffice for MuJoCo, if it moves alone."""
    if not body.explicitinertial:
        return True  # computed from its shapes
    return bool(min(body.mass, *body.inertia) >= mujoco.mjMINVAL)


def _direction(joint: Joint, tag: str) -> Vector:
    """The direction of an axis in the world, of unit length."""
    axis = joint.element.child(tag)
    if axis is None:
        if joint.type not in ("fixed", "ball") and tag == "axis2":
            joint.element.problem(f"a {joint.type} joint needs an <axis2>")
        default: Vector = joint.anchor.rotation @ np.array([0.0, 0.0, 1.0])
        return default
    xyz = axis.child("xyz")
    direction = np.array(axis.vector("xyz", (0.0, 0.0, 1.0)))
    length = np.linalg.norm(direction)
    if not length:
        (xyz or axis).problem("the axis has no direction: its length is zero")
        return np.array([0.0, 0.0, 1.0])
    named = "" if xyz is None else xyz.attributes.get("expressed_in", "")
    if axis.is_true("use_parent_model_frame", default=_is_old(joint.scope)):
        named = named or "__model__"
    frame = joint.scope.pose @ joint.scope.place(named, axis) if named else joint.anchor
    turned: Vector = frame.rotation @ (direction / length)
    return turned


def _is_old(scope: Scope) -> bool:
    """Whether axes are in the frame of the model, as until SDF 1.4."""
    for element in scope.element.and_ancestors():
        version = element.attributes.get("_version") or (
            element.attributes.get("version", "") if element.tag == "sdf" else ""
        )
        if version:
            numbers = version.split(".")
            return numbers[0] == "1" and len(numbers) > 1 and numbers[1] in "01234"
    return False


def is_known(joint: Element, types: Sequence[str]) -> bool:
    """Whether the type of a joint is among ``types``; a problem is reported."""
    if joint.type in types:
        return True
    joint.problem(f"'{joint.type}' is not a type of joint", f"there are: {', '.join(types)}")
    return False


def _add_joints(building: Building, branch: Branch, joint: Joint) -> None:
    """Add the joints between a body and its parent."""
    body, link = building.body(branch.link), branch.link
    place = link.pose.inverse() @ joint.anchor
    parts, is_screw = _PARTS[joint.type], joint.type == "screw"
    names = building.joints[joint.name] = []
    # MuJoCo applies the joints of a body in their order, the first next to the parent.
    for kind, tag in reversed(parts) if branch.is_turned else parts:
        direction = _direction(joint, tag) if tag else None
        made = body.add_joint(type=kind)
        if kind != _FREE:
            made.pos = place.position
        suffix = f"/{tag}" if len(parts) > 1 else ""
        if is_screw:
            suffix = "/turn" if kind == _HINGE else "/slide"
        made.name = building.name("joint", joint.name + suffix, joint.element)
        names.append(made.name)
        if direction is not None:
            local = link.pose.rotation.T @ direction
            made.axis = -local if branch.is_turned else local
            axis = joint.element.child(tag)
            if axis is not None and not (is_screw and kind == _SLIDE):
                _read_dynamics(axis, made, joint.type)
    if is_screw:
        # A soft constraint holds the hinge and the slide together.
        element = joint.element
        pitch = element.number("screw_thread_pitch", 0.0)
        if element.child("screw_thread_pitch") is None:
            # The older element: radians per metre, left-handed.
            old = element.number("thread_pitch", 1.0)
            pitch = -2 * math.pi / old if old else 0.0
        turn = next(name for name in names if name.endswith("/turn"))
        slide = next(name for name in names if name.endswith("/slide"))
        _follow(building, slide, turn, 0.0, pitch / (2 * math.pi))
        element.remark(
            "a screw is a hinge and a slide, held together by a soft constraint in MuJoCo"
        )
    if joint.type == "gearbox":
        joint.element.remark("a gearbox is a hinge without its gears in MuJoCo")


def _read_dynamics(axis: Element, joint: Any, joint_type: str) -> None:
    limit = axis.child("limit")
    if limit is not None:
        lower = limit.number("lower", _UNLIMITED_ENDS[0])
        upper = limit.number("upper", _UNLIMITED_ENDS[1])
        if lower > upper:
            limit.problem(
                f"the lower limit {lower:g} is above the upper one, {upper:g}",
                "a joint without limits is of type continuous",
            )
        elif joint_type != "continuous" and (lower > -HUGE or upper < HUGE):
            lower, upper = max(lower, -HUGE), min(upper, HUGE)
            if lower == upper:
                default = f" ({limit.text})" if limit.text else ""
                limit.remark(f"'{joint.name}' is locked: both its limits are {lower:g}{default}")
                upper = lower + max(_LOCKED[0], _LOCKED[1] * abs(lower))  # MuJoCo's is not empty
            joint.range, joint.limited = [lower, upper], True
        effort = limit.number("effort", math.inf)
        if effort == 0:
            limit.remark("an effort of 0 would let nothing drive the joint: there is no such limit")
        if mujoco.mjMINVAL < effort < HUGE:
            joint.actfrcrange, joint.actfrclimited = [-effort, effort], True
        velocity = limit.child("velocity")
        if velocity is not None:  # an effective limit is listed as unsupported
            velocity.is_read = not 0 <= limit.number("velocity", -1) < HUGE
    dynamics = axis.child("dynamics")
    if dynamics is not None:
        joint.damping[0] = dynamics.number("damping", 0.0, least=0.0)
        joint.frictionloss = dynamics.number("friction", 0.0, least=0.0)
        joint.stiffness[0] = dynamics.number("spring_stiffness", 0.0)
        joint.springref = dynamics.number("spring_reference", 0.0)


def _follow(building: Building, joint: str, leader: str, offset: float, ratio: float) -> None:
    """Constrain the position of a joint to ``offset`` + ``ratio`` times that of another."""
    kind, names = mujoco.mjtEq.mjEQ_JOINT, (joint, leader)
    equality = _add_equality(
        building.spec, kind, mujoco.mjtObj.mjOBJ_JOINT, names, [offset, ratio if leader else 0.0]
    )
    equality.name = building.name("equality", f"{joint} follows {leader}", None)


def _add_equality(
    spec: Any, kind: Any, sort: Any, names: tuple[str, str], data: Sequence[float]
) -> Any:
    first, second = names
    equality = spec.add_equality(type=kind, objtype=sort, name1=first, name2=second)
    equality.data = np.pad(data, (0, len(equality.data) - len(data)))
    return equality


def _add_mimics(building: Building, scope: Scope) -> None:
    """``<mimic>`` of an axis: the joint follows another one (SDF 1.11)."""
    for inner, element in scope.each("joint"):
        for tag in ("axis", "axis2"):
            mimic = element.child(tag, "mimic")
            if mimic is None:
                continue
            leader = mimic.attributes.get("joint") or mimic.text_of("joint")
            mine = building.joints.get(inner.prefix + element.name, [])
            theirs = building.joints.get(inner.prefix + leader.replace("::", "/"))
            if theirs is None:
                mimic.omit(f"'{element.name}' follows '{leader}', and there is no such joint")
                continue
            if mine == theirs or len(mine) != 1 or len(theirs) > 1:
                mimic.omit(f"'{element.name}' and '{leader}' must be two joints with one axis each")
                continue
            ratio = mimic.number("multiplier", 1.0)
            offset = mimic.number("offset", 0.0)
            reference = mimic.number("reference", 0.0)
            # A leader that does not move, a fixed joint, is at 0.
            _follow(building, mine[0], "".join(theirs), offset - ratio * reference, ratio)


def _exclude_contacts(building: Building, scope: Scope) -> None:
    """Exclude contacts between links of one model, unless the model wants them."""
    groups: dict[int, list[str]] = {}
    for inner in scope.and_models():
        outer = inner.outermost
        if outer.self_collides or outer.is_static:
            continue
        names = groups.setdefault(id(outer), [])
        names += [
            building.body(link).name
            for link in inner.links.values()
            if any(id(child) in building.geoms for child in link.element.children)
            and building.body(link).name != "world"
        ]
        if len(names) > _MOST_LINKS:
            outer.element.problem(
                f"more than {_MOST_LINKS} links of one model collide with other things",
                "set <self_collide>: then no list of pairs is needed",
            )
            return
    for names in groups.values():
        for index, first in enumerate(names):
            for second in names[index + 1 :]:
                building.spec.add_exclude(bodyname1=first, bodyname2=second)


def close_loop(building: Building, joint: Joint) -> None:
    """Constrain two bodies whose joint would close a loop: MuJoCo's bodies form a tree."""
    point = joint.anchor.position
    match joint.type:
        case "fixed":
            _hold(building, joint, _WELD, point)
        case "revolute" | "continuous":
            # Held at two points of its axis, the body can only turn about the axis.
            direction = _direction(joint, "axis")
            for end, name in ((-_HALF_HINGE_M, "/1"), (_HALF_HINGE_M, "/2")):
                _hold(building, joint, _CONNECT, point + end * direction, name)
        case "ball":
            _hold(building, joint, _CONNECT, point)
        case "universal":
            _hold(building, joint, _CONNECT, point)
            joint.element.omit(f"{_SOFT}; it may turn about the third axis, too")
            return
        case _:
            joint.element.omit(f"closes a loop, and MuJoCo has no {joint.type} constraint")
            return
    joint.element.omit(f"{_SOFT}: without limits, friction and damping")


def _hold(building: Building, joint: Joint, kind: object, point: Vector, suffix: str = "") -> None:
    first, second = joint.child or joint.parent, joint.parent if joint.child else None
    names = building.body(first).name, building.body(second).name if second else "world"
    # The weight of torque against force is 1; the zero pose means the present one.
    data: Any = [*[0.0] * 10, 1.0]
    if kind == _CONNECT and first is not None:
        data = first.pose.inverse().rotation @ (point - first.pose.position)
    equality = _add_equality(building.spec, kind, mujoco.mjtObj.mjOBJ_BODY, names, data)
    equality.name = building.name("equality", joint.name + suffix, joint.element)


def add_actuators(building: Building, scope: Scope) -> None:
    """Add an actuator for every joint controller of Gazebo's in a model and its nested models.

    ``JointPositionController`` is a PD controller, which is a ``position`` actuator;
    ``JointController`` holds a velocity, which is a ``velocity`` actuator. Other plugins are code
    that runs inside Gazebo, and are listed.
    """
    plugins = [
        (inner, plugin, plugin.name.rpartition("::")[2])
        for inner in scope.and_models()
        for plugin in inner.element.children
        if plugin.tag == "plugin"
    ]
    for inner, plugin, kind in plugins:
        if kind not in (_POSITION, _VELOCITY):
            continue
        names = [element.text for element in plugin.each("joint_name")]
        if not names:
            plugin.problem("<joint_name> is missing: which joint is driven?")
        for name in names:
            joints = building.joints.get(inner.prefix + name.replace("::", "/"), [])
            if len(joints) != 1:
                plugin.problem(f"there is no joint with one axis called '{name}'")
                continue
            actuator = building.spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.name = building.name("actuator", joints[0], plugin)
            actuator.target = joints[0]
            _set_gains(actuator, plugin, kind)
        if plugin.number("i_gain", 0.0) == 0:
            for tag in ("i_gain", "i_max", "i_min"):
                plugin.child(tag)
        else:
            plugin.remark("without the integral part: MuJoCo's servos have P and D")
        for tag in ("cmd_offset", *(["d_gain"] if kind == _VELOCITY else [])):
            child = plugin.child(tag)
            if child is not None and plugin.number(tag, 0.0) != 0:
                child.is_read = False  # effective in Gazebo, so listed as unsupported


def _set_gains(actuator: Any, plugin: Element, kind: str) -> None:
    plugin.is_read = True
    gain = plugin.number("p_gain", 1.0 if kind == _POSITION else _STIFF_GAIN)
    if kind == _POSITION:
        actuator.set_to_position(kp=gain, kv=max(0.0, plugin.number("d_gain", 0.1)))
    else:
        if plugin.text_of("use_force_commands") not in ("true", "1"):
            plugin.remark("Gazebo sets the velocity; here a gain (kv) holds it")
        actuator.set_to_velocity(kv=gain)
    least = plugin.number("cmd_min", -math.inf)
    most = plugin.number("cmd_max", math.inf)
    if least < most and not (math.isinf(least) and math.isinf(most)):
        actuator.forcerange, actuator.forcelimited = [max(least, -1e15), min(most, 1e15)], True
