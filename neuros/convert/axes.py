"""Where joints are, and which way their axes point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neuros.convert.elements import Element
from neuros.convert.numbers import is_true, vector
from neuros.convert.poses import Pose, Vector
from neuros.convert.report import Report
from neuros.convert.scopes import Scope
from neuros.convert.tree import Joint


@dataclass(frozen=True, eq=False)
class Axis:
    """An axis of a joint: its direction in the world (unit length), and what limits it."""

    element: Element | None
    direction: Vector


def anchor(joint: Joint) -> Pose:
    """Where a joint is, in the world."""
    scope = joint.scope
    return scope.pose @ scope.place(joint.element.name, joint.element)


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
