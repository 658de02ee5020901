"""Joints that close a loop of links: constraints in MuJoCo, whose bodies form a tree."""

from __future__ import annotations

import mujoco
import numpy as np

from neuros.convert.axes import anchor, read_axis
from neuros.convert.building import Building
from neuros.convert.poses import Vector
from neuros.convert.tree import Joint

_HALF_HINGE_M = 0.05
_SOFT = "closes a loop: a soft constraint in MuJoCo, not a joint"
_CONNECT = mujoco.mjtEq.mjEQ_CONNECT
_WELD = mujoco.mjtEq.mjEQ_WELD


def close_loop(building: Building, joint: Joint) -> None:
    """Hold two bodies together that the tree does not join; noted, as it is another thing."""
    report = building.report
    place = anchor(joint)
    if joint.type == "fixed":
        _hold(building, joint, _WELD, place.position, "")
    elif joint.type in ("revolute", "continuous"):
        # Held at two points of its axis, it can turn about nothing else.
        direction = read_axis(joint, "axis", report).direction
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
