"""What the node file says about sensors and actuators, read and checked without a model.

Every problem is gathered, so that the user sees all of them at once; what needs the model (names
of elements, whole numbers of timesteps) is checked when sensors and commands are bound to it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from neuros.errors import ModelError
from neuros.project.model import Node, Port
from neuros.simulators.mujoco.drives import DRIVE_KEYS, Drive, read_drive


@dataclass(frozen=True)
class SensorKind:
    """What one kind of sensor can be declared with.

    ``types`` are the message types that it can fill; ``list_types`` those of them that take a list
    of elements; ``element`` says whether one has to be named.
    """

    types: tuple[str, ...]
    element: str = "required"  # or "optional", or "none"
    list_types: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()


SENSOR_KINDS: Mapping[str, SensorKind] = {
    "imu": SensorKind(("sensor_msgs/msg/Imu",)),
    "pose": SensorKind(("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/Pose")),
    "joint_states": SensorKind(
        ("sensor_msgs/msg/JointState",), "optional", ("sensor_msgs/msg/JointState",)
    ),
    "contacts": SensorKind(
        (
            "std_msgs/msg/Bool",
            "std_msgs/msg/Float64",
            "std_msgs/msg/Float64MultiArray",
            "geometry_msgs/msg/WrenchStamped",
        ),
        list_types=("std_msgs/msg/Float64MultiArray",),
    ),
    "camera": SensorKind(("sensor_msgs/msg/Image",), keys=("width", "height")),
    "clock": SensorKind(("rosgraph_msgs/msg/Clock",), "none"),
}

COMMAND_SIZES: Mapping[str, tuple[int, ...]] = {
    "std_msgs/msg/Float64": (1,),
    "std_msgs/msg/Float64MultiArray": (),
    "sensor_msgs/msg/JointState": (),
    "geometry_msgs/msg/Twist": (2, 3, 6),
}
"""Message types of commands, and how many actuators each can drive (empty: any number)."""

_NAMING = ("actuator", "actuators", "joint", "joints")

DEFAULT_WIDTH, DEFAULT_HEIGHT = 640, 480


@dataclass(frozen=True)
class SensorDeclaration:
    """A sensor behind an output. ``pointer`` is the place of its ``mujoco`` key in the file."""

    output: str
    type: str
    kind: str
    elements: tuple[str, ...]
    rate_hz: float
    pointer: str
    width: int = DEFAULT_WIDTH
    height: int = DEFAULT_HEIGHT


@dataclass(frozen=True)
class CommandDeclaration:
    """The actuators behind an input, in their order. ``pointer`` is the place of their names.

    With a ``drive`` the names are those of joints, and each gets an actuator of its name.
    """

    input: str
    type: str
    actuators: tuple[str, ...]
    pointer: str
    drive: Drive | None = None


class Problems:
    """Gathers what is wrong in one file, and raises all of it in one ``ModelError``.

    ``hint`` stands at the end of each.
    """

    def __init__(self, file: object, hint: str = "") -> None:
        self._file, self._hint = file, hint
        self._texts: list[str] = []

    def add(self, pointer: str, text: str) -> None:
        self._texts.append(f"{self._file}: {pointer}: {text}{self._hint}")

    def add_text(self, text: str) -> None:
        """A problem of another file, with its address already in the text."""
        self._texts.append(text)

    def raise_any(self) -> None:
        if self._texts:
            raise ModelError("\n".join(self._texts))


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """``" (did you mean 'x'?)"``, else the first few possibilities, else nothing."""
    names = sorted(name for name in known if name)
    close = get_close_matches(word, names, n=1)
    if close:
        return f" (did you mean '{close[0]}'?)"
    if not names:
        return ""
    return f" (there are: {', '.join(names[:8])}{', ...' if len(names) > 8 else ''})"


def read_sensors(node: Node, problems: Problems) -> tuple[SensorDeclaration, ...]:
    """The sensors that the outputs of ``node`` declare; faulty ones are left out and reported."""
    found = (
        _sensor(port, f"{node.pointer}/outputs/{index}/mujoco", problems)
        for index, port in enumerate(node.outputs)
        if port.mujoco
    )
    return tuple(sensor for sensor in found if sensor)


def read_commands(node: Node, problems: Problems) -> tuple[CommandDeclaration, ...]:
    """The commands that the inputs of ``node`` declare; faulty ones are left out and reported."""
    found = (
        _command(port, f"{node.pointer}/inputs/{index}/mujoco", problems)
        for index, port in enumerate(node.inputs)
        if port.mujoco
    )
    return tuple(command for command in found if command)


def _sensor(port: Port, pointer: str, problems: Problems) -> SensorDeclaration | None:
    name = port.mujoco.get("sensor")
    kind = SENSOR_KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        hint = did_you_mean(str(name or ""), SENSOR_KINDS)
        problems.add(f"{pointer}/sensor", f"{name!r} is not a kind of sensor{hint}")
        return None
    faults = _Faults(pointer, problems)
    faults.unknown_keys(port.mujoco, ("sensor", "element", "rate", *kind.keys))
    if port.type not in kind.types:
        faults.add(
            "sensor",
            f"'{name}' fills {_either(kind.types)}, but output '{port.name}' is a {port.type}",
        )
    elements = _elements(port, kind, faults)
    rate: Any = port.mujoco.get("rate")
    if not _is_positive(rate):
        faults.add("rate", f"{rate!r} is not a positive number (firings per simulated second)")
        rate = 1
    size = {key: _pixels(port.mujoco, key, faults) for key in kind.keys if key in port.mujoco}
    if faults.found:
        return None
    return SensorDeclaration(
        port.name, port.type, str(name), elements, float(rate), pointer, **size
    )


def _elements(port: Port, kind: SensorKind, faults: _Faults) -> tuple[str, ...]:
    value = port.mujoco.get("element")
    if value is None:
        if kind.element == "required":
            faults.add("element", "missing: name the element of the model that is measured")
        return ()
    if kind.element == "none":
        faults.add("element", "a clock measures no element: leave this key out")
        return ()
    if isinstance(value, str):
        return (value,)
    if not _is_list_of_names(value):
        faults.add("element", f"{value!r} is neither a name nor a list of names")
        return ()
    if port.type not in kind.list_types:
        hint = f"; a list needs {_either(kind.list_types)}" if kind.list_types else ""
        faults.add("element", f"a {port.type} holds one element only{hint}")
        return ()
    return tuple(value)


def _command(port: Port, pointer: str, problems: Problems) -> CommandDeclaration | None:
    faults = _Faults(pointer, problems)
    given = [key for key in _NAMING if key in port.mujoco]
    if len(given) != 1:
        faults.add("", f"give either {_either([repr(key) for key in _NAMING])}")
        return None
    (key,) = given
    drives = key in ("joint", "joints")
    faults.unknown_keys(port.mujoco, (*_NAMING, *(DRIVE_KEYS if drives else ())))
    value = port.mujoco[key]
    is_one = key in ("actuator", "joint")
    names = (value,) if is_one else value
    if not _is_list_of_names(names):
        faults.add(key, f"{value!r} is not a {'name' if is_one else 'list of names'}")
        return None
    drive = read_drive(port.mujoco, faults.add) if drives else None
    if port.type not in COMMAND_SIZES:
        text = f"input '{port.name}' is a {port.type}; a command is {_either(tuple(COMMAND_SIZES))}"
        faults.add(key, text)
    elif COMMAND_SIZES[port.type] and len(names) not in COMMAND_SIZES[port.type]:
        sizes = " or ".join(str(size) for size in COMMAND_SIZES[port.type])
        faults.add(key, f"a {port.type} drives {sizes} actuators, not {len(names)}")
    if faults.found:
        return None
    return CommandDeclaration(port.name, port.type, tuple(names), f"{pointer}/{key}", drive)


class _Faults:
    """Problems of one ``mujoco`` object."""

    def __init__(self, pointer: str, problems: Problems) -> None:
        self._pointer, self._problems, self.found = pointer, problems, False

    def add(self, key: str, text: str) -> None:
        self.found = True
        self._problems.add(f"{self._pointer}/{key}" if key else self._pointer, text)

    def unknown_keys(self, declared: Mapping[str, Any], known: Sequence[str]) -> None:
        for key in declared:
            if key not in known:
                self.add(key, f"unknown key{did_you_mean(key, known)}")


def _pixels(declared: Mapping[str, Any], key: str, faults: _Faults) -> int:
    value = declared[key]
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 16384:
        faults.add(key, f"{value!r} is not a number of pixels from 1 to 16384")
        return 1
    return value


def _is_positive(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return 0 < value < float("inf")


def _is_list_of_names(value: object) -> bool:
    return (
        isinstance(value, list | tuple)
        and bool(value)
        and all(isinstance(name, str) and name for name in value)
        and len(set(value)) == len(value)
    )


def _either(types: Sequence[str]) -> str:
    return " or ".join(types)
