"""From ROS messages to MuJoCo's controls.

===============================  ===========================================================
message type                     what it drives
===============================  ===========================================================
``std_msgs/Float64``             one actuator
``std_msgs/Float64MultiArray``   any number, in the order of ``actuators``
``sensor_msgs/JointState``       those of ``actuators`` that it names, by joint or actuator:
                                 position servos take ``position``, velocity servos
                                 ``velocity``, all others ``effort``
``geometry_msgs/Twist``          two actuators: linear.x, angular.z; three: linear.x,
                                 linear.y, angular.z; six: all. They are passed on, not
                                 turned into another frame
===============================  ===========================================================

MuJoCo clamps a control to the ``ctrlrange`` of its actuator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeAlias

import mujoco

from neuros.errors import ModelError
from neuros.ports import Packet
from neuros.simulators.mujoco.declarations import CommandDeclaration, Problems, did_you_mean
from neuros.simulators.mujoco.elements import find, names_of

Controls: TypeAlias = "list[tuple[int, float]]"
"""Pairs of actuator id and new control."""

Command: TypeAlias = Callable[[Packet], Controls]

_TWIST_FIELDS = {
    2: (("linear", "x"), ("angular", "z")),
    3: (("linear", "x"), ("linear", "y"), ("angular", "z")),
    6: tuple((part, axis) for part in ("linear", "angular") for axis in "xyz"),
}


def bind_commands(
    model: Any, declarations: Iterable[CommandDeclaration], problems: Problems
) -> dict[str, Command]:
    """For each input the function from its packets to controls; problems are reported."""
    commands: dict[str, Command] = {}
    for declaration in declarations:
        found = [_find(model, declaration, name, problems) for name in declaration.actuators]
        actuators = [element[1] for element in found if element]
        commands[declaration.input] = _checked(
            declaration.input, _MAKERS[declaration.type](model, actuators, declaration.input)
        )
    return commands


def _find(
    model: Any, declaration: CommandDeclaration, name: str, problems: Problems
) -> tuple[str, int] | None:
    """An actuator; one that a drive has added is missing only with its joint."""
    what = "actuator" if declaration.drive is None else "joint"
    found = find(model, (what,), name, declaration.pointer, problems)
    if found is None or what == "actuator":
        return found
    return find(model, ("actuator",), name, declaration.pointer, problems)


def control(model: Any, actuator: str, value: float) -> Controls:
    """One control by the name of its actuator; raises ``ModelError``."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR.value, actuator)
    if index < 0:
        hint = did_you_mean(actuator, names_of(model, "actuator"))
        raise ModelError(f"the model has no actuator '{actuator}'{hint}")
    return _checked(f"actuate('{actuator}')", lambda _: [(index, float(value))])(None)


def _checked(where: str, command: Command) -> Command:
    def run(packet: Packet) -> Controls:
        controls = command(packet)
        for _, value in controls:
            if not math.isfinite(value):
                raise ModelError(f"{where}: a command must be a finite number, not {value}")
        return controls

    return run


def _float(model: Any, actuators: list[int], where: str) -> Command:
    return lambda packet: [(actuators[0], float(packet.data))]


def _floats(model: Any, actuators: list[int], where: str) -> Command:
    def read(packet: Packet) -> Controls:
        if len(packet.data) != len(actuators):
            raise ModelError(
                f"input '{where}': {len(packet.data)} values for {len(actuators)} actuators"
            )
        return [(index, float(value)) for index, value in zip(actuators, packet.data, strict=True)]

    return read


def _twist(model: Any, actuators: list[int], where: str) -> Command:
    fields = _TWIST_FIELDS.get(len(actuators), ())
    return lambda packet: [
        (index, float(getattr(getattr(packet, part), axis)))
        for index, (part, axis) in zip(actuators, fields, strict=True)
    ]


def _joint_state(model: Any, actuators: list[int], where: str) -> Command:
    targets = _targets_by_name(model, actuators)

    def read(packet: Packet) -> Controls:
        controls: Controls = []
        for position, name in enumerate(packet.name):
            if name not in targets:
                hint = did_you_mean(name, targets)
                raise ModelError(f"input '{where}': no actuator of it moves '{name}'{hint}")
            wanted = [field for _, field in targets[name]]
            new = [
                (index, float(getattr(packet, field)[position]))
                for index, field in targets[name]
                if len(getattr(packet, field)) > position
            ]
            if not new:
                raise ModelError(
                    f"input '{where}': the command for '{name}' has no {' or '.join(wanted)}"
                )
            controls += new
        return controls

    return read


def _targets_by_name(model: Any, actuators: list[int]) -> Mapping[str, list[tuple[int, str]]]:
    """Actuators, and the field of a JointState that each takes, by actuator and joint name."""
    joints, names = names_of(model, "joint"), names_of(model, "actuator")
    on_joint = (mujoco.mjtTrn.mjTRN_JOINT.value, mujoco.mjtTrn.mjTRN_JOINTINPARENT.value)
    targets: dict[str, list[tuple[int, str]]] = {}
    for index in actuators:
        target = (index, _field(model, index))
        if model.actuator_trntype[index] in on_joint:
            targets.setdefault(joints[model.actuator_trnid[index, 0]], []).append(target)
    targets.pop("", None)
    # The name of an actuator means that one alone, even where a joint has the same name.
    targets.update({names[index]: [(index, _field(model, index))] for index in actuators})
    return targets


def _field(model: Any, actuator: int) -> str:
    """What an actuator's control is: a servo subtracts the measured quantity from it."""
    if model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_AFFINE.value:
        return "effort"
    _, of_position, of_velocity = model.actuator_biasprm[actuator, :3]
    if of_position < 0:
        return "position"
    return "velocity" if of_velocity < 0 else "effort"


_MAKERS: Mapping[str, Callable[[Any, list[int], str], Command]] = {
    "std_msgs/msg/Float64": _float,
    "std_msgs/msg/Float64MultiArray": _floats,
    "sensor_msgs/msg/JointState": _joint_state,
    "geometry_msgs/msg/Twist": _twist,
}
