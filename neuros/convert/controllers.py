"""Gazebo's joint controllers: MuJoCo's actuators do what the common ones do.

``JointPositionController`` is a PD controller, which is a ``position`` actuator;
``JointController`` holds a velocity, which is a ``velocity`` actuator. Every other plugin is code
that runs inside Gazebo, and is listed.
"""

from __future__ import annotations

import math
from typing import Any

import mujoco

from neuros.convert.building import Building
from neuros.convert.elements import Element
from neuros.convert.numbers import number, word
from neuros.convert.report import Report
from neuros.convert.scopes import Scope

_POSITION, _VELOCITY = "JointPositionController", "JointController"
_STIFF_GAIN = 1000.0


def add_actuators(building: Building, scope: Scope) -> None:
    """An actuator for every joint controller of a model and those in it."""
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
        if word(plugin, "use_force_commands") not in ("true", "1"):
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
