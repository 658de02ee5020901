"""Joints that follow others: screws, and ``<mimic>``. Constraints in MuJoCo."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from neuros.convert.building import Building
from neuros.convert.numbers import number, word
from neuros.convert.scopes import Scope
from neuros.convert.tree import Joint


def couple_screw(building: Building, joint: Joint, names: list[str]) -> None:
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
