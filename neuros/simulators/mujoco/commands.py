"""Commands: inputs that drive actuators, declared in the node file, and their ROS messages.

For a joint without an actuator the node file declares a drive:
``{"joint": "elbow", "drive": "position", "kp": 50, "kv": 5, "force_limit": 10}``. MuJoCo clamps a
control to the ``ctrlrange`` of its actuator. ``docs/simulators.md`` has the message types.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import mujoco

from neuros.errors import ModelError
from neuros.ports import Packet
from neuros.project.message_types import array_type
from neuros.project.model import Node, Port
from neuros.simulators.mujoco.lookup import (
    Faults,
    Problems,
    did_you_mean,
    find,
    form_of,
    id_of,
    is_list_of_names,
    names_of,
)

Controls: TypeAlias = "list[tuple[int, float]]"
"""Pairs of actuator id and new control."""

Command: TypeAlias = Callable[[Packet], Controls]

_TWIST_FIELDS = {
    2: (("linear", "x"), ("angular", "z")),
    3: (("linear", "x"), ("linear", "y"), ("angular", "z")),
    6: tuple((part, axis) for part in ("linear", "angular") for axis in "xyz"),
}
ALL = "all"
"""In the place of the names of actuators: all of the model, in its order."""
_NAMING = ("actuator", "actuators", "joint", "joints")
_GAINS: Mapping[str, Mapping[str, bool]] = {
    "position": {"kp": True, "kv": False},
    "velocity": {"kv": True},
    "motor": {},
}
"""The gains of each kind of drive, and whether it needs them."""
_DRIVE_KEYS = ("drive", "kp", "kv", "force_limit")


@dataclass(frozen=True)
class Drive:
    """An actuator that the node file adds to a joint.

    ``kp`` is in N/m or N m/rad, ``kv`` in N s/m or N m s/rad, ``force_limit`` in N or N m.
    """

    kind: str
    kp: float = 0.0
    kv: float = 0.0
    force_limit: float | None = None


@dataclass(frozen=True)
class CommandDeclaration:
    """The actuators behind an input, in their order; empty: all of the model.

    ``pointer`` is the place of their names.

    With a ``drive`` the names are joints, and each joint gets an actuator of its name.
    """

    input: str
    type: str
    actuators: tuple[str, ...]
    pointer: str
    drive: Drive | None = None


def read_commands(node: Node, problems: Problems) -> tuple[CommandDeclaration, ...]:
    """The commands that the inputs of ``node`` declare; faulty ones are left out and reported."""
    found = (
        _command(port, f"{node.pointer}/inputs/{index}/mujoco", problems)
        for index, port in enumerate(node.inputs)
        if port.mujoco
    )
    return tuple(command for command in found if command)


def _command(port: Port, pointer: str, problems: Problems) -> CommandDeclaration | None:
    faults = Faults(pointer, problems)
    given = [key for key in _NAMING if key in port.mujoco]
    if len(given) != 1:
        faults.add("", f"give either {' or '.join(map(repr, _NAMING))}")
        return None
    (key,) = given
    drives = key in ("joint", "joints")
    faults.unknown_keys(port.mujoco, (*_NAMING, *(_DRIVE_KEYS if drives else ())))
    value, is_one = port.mujoco[key], key in ("actuator", "joint")
    names = (value,) if is_one else value
    if key == "actuators" and value == ALL:
        names = ()
    elif not is_list_of_names(names):
        faults.add(key, f"{value!r} is not a {'name' if is_one else 'list of names'}")
        return None
    drive = _read_drive(port.mujoco, faults) if drives else None
    form = form_of(port.type)
    if port.array and names and port.array.shape != (len(names),):
        faults.add(key, f"a {port.type} does not fit {len(names)} actuators")
    if form not in _MESSAGE_TYPES:
        if drive is None:  # with a drive, the plugin may read the message and drive each joint
            known = " or ".join(_MESSAGE_TYPES)
            faults.add(key, f"input '{port.name}' is a {port.type}; a command is {known}")
    elif (sizes := _MESSAGE_TYPES[form][1]) and len(names) not in sizes:
        some = " or ".join(map(str, sizes))
        faults.add(key, f"a {port.type} drives {some} actuators, not {len(names) or ALL}")
    if faults.found:
        return None
    return CommandDeclaration(port.name, port.type, tuple(names), f"{pointer}/{key}", drive)


def _read_drive(declared: Mapping[str, Any], faults: Faults) -> Drive | None:
    kind = declared.get("drive")
    if not isinstance(kind, str) or kind not in _GAINS:
        faults.add("drive", f"{kind!r} is not one of {', '.join(_GAINS)}")
        return None
    gains, values = {**_GAINS[kind], "force_limit": False}, dict[str, float]()
    for key in _DRIVE_KEYS[1:]:
        value = declared.get(key)
        if key not in declared:
            if gains.get(key):
                faults.add(key, f"missing: a {kind} drive needs it")
        elif key not in gains:
            faults.add(key, f"a {kind} drive has no {key}")
        elif isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            faults.add(key, f"{value!r} is not a positive number")
        else:
            values[key] = float(value)
    return Drive(kind, **values)


def add_drives(
    spec: Any, joints: Collection[str], commands: Iterable[CommandDeclaration], problems: Problems
) -> None:
    """Add the actuators that the node file declares for ``joints`` to an ``MjSpec``.

    A joint that the model lacks is reported when the commands are bound.
    """
    for command in commands:
        drive = command.drive
        if drive is None:
            continue
        for name in filter(joints.__contains__, command.actuators):
            if spec.actuator(name) is not None:
                fault = f"the model has an actuator '{name}': name that with 'actuator'"
                problems.add(command.pointer, fault)
                continue
            actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            if drive.kind == "position":
                actuator.set_to_position(kp=drive.kp, kv=drive.kv)
            elif drive.kind == "velocity":
                actuator.set_to_velocity(kv=drive.kv)
            else:
                actuator.set_to_motor()
            if drive.force_limit is not None:
                actuator.forcelimited = True
                actuator.forcerange = [-drive.force_limit, drive.force_limit]


def bind_commands(
    model: Any, declarations: Iterable[CommandDeclaration], problems: Problems
) -> dict[str, Command]:
    """For each input the function from its packets to controls; problems are reported."""
    commands: dict[str, Command] = {}
    for declared in declarations:
        # The actuator that a drive has added is missing only with its joint.
        sort = "actuator" if declared.drive is None else "joint"
        known = [
            name
            for name in declared.actuators
            if find(model, (sort,), name, declared.pointer, problems)
        ]
        found = [find(model, ("actuator",), name, declared.pointer, problems) for name in known]
        read, _ = _MESSAGE_TYPES.get(form_of(declared.type), (_refuse, ()))
        actuators = [actuator for _, actuator in filter(None, found)]
        if not declared.actuators:
            actuators, array = [*range(model.nu)], array_type(declared.type)
            if array is not None and array.shape != (model.nu,):
                fault = f"a {array} does not fit the {model.nu} actuators of the model"
                problems.add(declared.pointer, fault)
        command = read(model, actuators, declared.input)
        commands[declared.input] = _checked(declared.input, command)
    return commands


def control(model: Any, actuator: str, value: float) -> Controls:
    """One control by the name of its actuator; raises ``ModelError``."""
    index = id_of(model, "actuator", actuator)
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


def _refuse(model: Any, actuators: list[int], where: str) -> Command:
    """A message type of the user: the plugin must read it, and drive the joints itself."""
    names = [names_of(model, "actuator")[index] for index in actuators]

    def read(packet: Packet) -> Controls:
        raise ModelError(
            f"input '{where}': a {type(packet).__name__} is no command by itself: drive its joints"
            f" one by one, as by actuate('{names[0]}', value)"
        )

    return read


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


def _array(model: Any, actuators: list[int], where: str) -> Command:
    return lambda packet: list(zip(actuators, packet.tolist(), strict=True))


def _twist(model: Any, actuators: list[int], where: str) -> Command:
    fields = _TWIST_FIELDS.get(len(actuators), ())
    return lambda packet: [
        (index, float(getattr(getattr(packet, part), axis)))
        for index, (part, axis) in zip(actuators, fields, strict=True)
    ]


def _joint_state(model: Any, actuators: list[int], where: str) -> Command:
    joints, names = names_of(model, "joint"), names_of(model, "actuator")
    on_joint = (mujoco.mjtTrn.mjTRN_JOINT.value, mujoco.mjtTrn.mjTRN_JOINTINPARENT.value)
    # By actuator and joint name: actuators, and the field of a JointState that drives each.
    targets: dict[str, list[tuple[int, str]]] = {}
    for index in actuators:
        target = (index, _field(model, index))
        if model.actuator_trntype[index] in on_joint:
            targets.setdefault(joints[model.actuator_trnid[index, 0]], []).append(target)
    targets.pop("", None)
    # The name of an actuator means that one alone, even where a joint has the same name.
    targets.update({names[index]: [(index, _field(model, index))] for index in actuators})

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


def _field(model: Any, actuator: int) -> str:
    """The field of a JointState that drives an actuator: the quantity that a servo subtracts."""
    if model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_AFFINE.value:
        return "effort"
    _, of_position, of_velocity = model.actuator_biasprm[actuator, :3]
    if of_position < 0:
        return "position"
    return "velocity" if of_velocity < 0 else "effort"


_MESSAGE_TYPES: Mapping[str, tuple[Callable[[Any, list[int], str], Command], tuple[int, ...]]] = {
    "std_msgs/msg/Float64": (_float, (1,)),
    "std_msgs/msg/Float64MultiArray": (_floats, ()),
    "float64[...]": (_array, ()),
    "float32[...]": (_array, ()),
    "sensor_msgs/msg/JointState": (_joint_state, ()),
    "geometry_msgs/msg/Twist": (_twist, (2, 3, 6)),
}
"""For each type the factory of its command, and how many actuators it can drive (empty: any)."""
