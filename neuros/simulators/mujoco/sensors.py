"""Sensors: declarations in the node file, measured quantities, and the ROS messages they fill.

Declarations are read and checked without a model; every problem is gathered, so that the user sees
all of them at once. Each ``_bind_...`` then looks the elements up once, by name, and returns a
function that fills a packet from the data right after ``mj_forward``; only that runs at a firing.

Where the model has a sensor of its own at the element (``gyro``, ``accelerometer``, ``framequat``),
its reading is taken, with its cutoff. Otherwise the quantity is computed from the data, as MuJoCo's
sensors compute it.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt

from neuros.ports import Packet
from neuros.project.model import Node, Port
from neuros.simulators.mujoco.cameras import Cameras
from neuros.simulators.mujoco.declarations import (
    Faults,
    Problems,
    did_you_mean,
    either,
    find,
    is_list_of_names,
    names_of,
)

Fill: TypeAlias = Callable[[Packet, Any, int], None]
"""``fill(packet, data, time_ns)``."""

Vector: TypeAlias = "list[float]"
"""3 numbers, or 4 for a quaternion, w first: plain ones, as messages want them."""

_WORLD_FRAME = "world"


@dataclass(frozen=True)
class SensorDeclaration:
    """A sensor behind an output. ``pointer`` is the place of its ``mujoco`` key in the file."""

    output: str
    type: str
    kind: str
    elements: tuple[str, ...]
    rate_hz: float
    pointer: str
    width: int = 640
    height: int = 480


@dataclass(frozen=True)
class Binding:
    """One declaration on its way to a :data:`Fill`."""

    declaration: SensorDeclaration
    model: Any
    cameras: Cameras
    problems: Problems

    def find(self, *sorts: str) -> tuple[str, int] | None:
        """The one element of the declaration."""
        name, pointer = self.declaration.elements[0], f"{self.declaration.pointer}/element"
        return find(self.model, sorts, name, pointer, self.problems)

    def find_all(self, *sorts: str) -> list[tuple[str, int]]:
        """The elements of the declaration, in order; unknown ones are reported and left out."""
        pointer = f"{self.declaration.pointer}/element"
        found = (
            find(self.model, sorts, name, pointer, self.problems)
            for name in self.declaration.elements
        )
        return [element for element in found if element]


@dataclass(frozen=True)
class SensorKind:
    """One kind of sensor: what it can be declared with, and how it is bound to a model.

    ``types`` are the message types that it can fill; ``list_types`` those of them that take a list
    of elements; ``element`` says whether one has to be named.
    """

    bind: Callable[[Binding], Fill | None]
    types: tuple[str, ...]
    element: str = "required"  # or "optional", or "none"
    list_types: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()


def read_sensors(node: Node, problems: Problems) -> tuple[SensorDeclaration, ...]:
    """The sensors that the outputs of ``node`` declare; faulty ones are left out and reported."""
    found = (
        _sensor(port, f"{node.pointer}/outputs/{index}/mujoco", problems)
        for index, port in enumerate(node.outputs)
        if port.mujoco
    )
    return tuple(sensor for sensor in found if sensor)


def _sensor(port: Port, pointer: str, problems: Problems) -> SensorDeclaration | None:
    name = port.mujoco.get("sensor")
    kind = SENSOR_KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        hint = did_you_mean(str(name or ""), SENSOR_KINDS)
        problems.add(f"{pointer}/sensor", f"{name!r} is not a kind of sensor{hint}")
        return None
    faults = Faults(pointer, problems)
    faults.unknown_keys(port.mujoco, ("sensor", "element", "rate", *kind.keys))
    if port.type not in kind.types:
        faults.add(
            "sensor",
            f"'{name}' fills {either(kind.types)}, but output '{port.name}' is a {port.type}",
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


def _elements(port: Port, kind: SensorKind, faults: Faults) -> tuple[str, ...]:
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
    if not is_list_of_names(value):
        faults.add("element", f"{value!r} is neither a name nor a list of names")
        return ()
    if port.type not in kind.list_types:
        hint = f"; a list needs {either(kind.list_types)}" if kind.list_types else ""
        faults.add("element", f"a {port.type} holds one element only{hint}")
        return ()
    return tuple(value)


def _pixels(declared: Mapping[str, Any], key: str, faults: Faults) -> int:
    value = declared[key]
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 16384:
        faults.add(key, f"{value!r} is not a number of pixels from 1 to 16384")
        return 1
    return value


def _is_positive(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return 0 < value < float("inf")


def _set_time(time: Any, time_ns: int) -> None:
    """Set a ``builtin_interfaces/Time``."""
    time.sec, time.nanosec = divmod(time_ns, 1_000_000_000)


def _set_header(header: Any, time_ns: int, frame: str) -> None:
    _set_time(header.stamp, time_ns)
    header.frame_id = frame


def _set_vector(vector: Any, values: Vector) -> None:
    vector.x, vector.y, vector.z = values


def _set_quaternion(quaternion: Any, values: Vector) -> None:
    """ROS writes the real part last, MuJoCo first."""
    quaternion.w, quaternion.x, quaternion.y, quaternion.z = values


class _Place:
    """The frame of a site, or of a body (its own frame, not the one of its inertia)."""

    def __init__(self, model: Any, what: str, index: int) -> None:
        self._model, self._is_site, self.index = model, what == "site", index
        objects = mujoco.mjtObj
        self.object = (objects.mjOBJ_SITE if self._is_site else objects.mjOBJ_XBODY).value
        self._spatial, self._turned = np.zeros(6), np.zeros(4)
        if self._is_site:
            self._body = int(model.site_bodyid[index])
            self._in_body = model.site_quat[index]

    def position(self, data: Any) -> Vector:
        """In the world, metres."""
        positions = data.site_xpos if self._is_site else data.xpos
        return _plain(positions[self.index])

    def orientation(self, data: Any) -> Vector:
        """In the world, a unit quaternion."""
        if not self._is_site:
            return _plain(data.xquat[self.index])
        mujoco.mju_mulQuat(self._turned, data.xquat[self._body], self._in_body)
        return _plain(self._turned)

    def angular_velocity(self, data: Any) -> Vector:
        """In the frame of the place, rad/s: a gyroscope."""
        mujoco.mj_objectVelocity(self._model, data, self.object, self.index, self._spatial, 1)
        return _plain(self._spatial[:3])

    def acceleration(self, data: Any) -> Vector:
        """In the frame of the place, m/s^2, gravity included: an accelerometer."""
        # mj_forward leaves the accelerations out unless a sensor of the model needs them.
        if not getattr(data, "flg_rnepost", False):
            mujoco.mj_rnePostConstraint(self._model, data)
        mujoco.mj_objectAcceleration(self._model, data, self.object, self.index, self._spatial, 1)
        return _plain(self._spatial[3:])


def _plain(values: Any) -> Vector:
    numbers: Vector = values.tolist()
    return numbers


@dataclass(frozen=True)
class _OwnSensor:
    """A sensor that the model declares: where its reading is, and the square of its ``noise``."""

    start: int
    end: int
    variance: float

    def read(self, data: Any) -> Vector:
        return _plain(data.sensordata[self.start : self.end])


def _own_sensor(model: Any, sensor_type: Any, place: _Place) -> _OwnSensor | None:
    """The model's first sensor of a type at a place that is measured in the world's frame."""
    for index in range(model.nsensor):
        if (
            model.sensor_type[index] == sensor_type.value
            and model.sensor_objtype[index] == place.object
            and model.sensor_objid[index] == place.index
            and model.sensor_refid[index] == -1
        ):
            start = int(model.sensor_adr[index])
            end = start + int(model.sensor_dim[index])
            return _OwnSensor(start, end, float(model.sensor_noise[index]) ** 2)
    return None


def _bind_imu(binding: Binding) -> Fill | None:
    """``sensor_msgs/Imu`` in the frame of a site or body, as REP 145 wants it.

    ``linear_acceleration`` (m/s^2) includes gravity: +9.81 upwards at rest, 0 in free fall.
    ``angular_velocity`` in rad/s; ``orientation`` of the element in the world. Covariances: the
    square of ``noise`` of the model's own sensor on the diagonal, else zeros ("unknown"). MuJoCo
    adds no noise to readings, and neither is any added here.
    """
    element = binding.find("site", "body")
    if element is None:
        return None
    model, frame = binding.model, binding.declaration.elements[0]
    place = _Place(model, *element)
    gyro = _own_sensor(model, mujoco.mjtSensor.mjSENS_GYRO, place)
    accelerometer = _own_sensor(model, mujoco.mjtSensor.mjSENS_ACCELEROMETER, place)
    orientation = _own_sensor(model, mujoco.mjtSensor.mjSENS_FRAMEQUAT, place)

    def fill(packet: Packet, data: Any, time_ns: int) -> None:
        _set_header(packet.header, time_ns, frame)
        velocity = gyro.read(data) if gyro else place.angular_velocity(data)
        acceleration = accelerometer.read(data) if accelerometer else place.acceleration(data)
        attitude = orientation.read(data) if orientation else place.orientation(data)
        _set_vector(packet.angular_velocity, velocity)
        _set_vector(packet.linear_acceleration, acceleration)
        _set_quaternion(packet.orientation, attitude)
        if gyro:
            packet.angular_velocity_covariance[::4] = gyro.variance
        if accelerometer:
            packet.linear_acceleration_covariance[::4] = accelerometer.variance
        if orientation:
            packet.orientation_covariance[::4] = orientation.variance

    return fill


def _bind_pose(binding: Binding) -> Fill | None:
    """``geometry_msgs/PoseStamped`` or ``Pose`` of a site or body in the world, in metres."""
    element = binding.find("site", "body")
    if element is None:
        return None
    place = _Place(binding.model, *element)
    stamped = binding.declaration.type.endswith("Stamped")

    def fill(packet: Packet, data: Any, time_ns: int) -> None:
        if stamped:
            _set_header(packet.header, time_ns, _WORLD_FRAME)
        pose = packet.pose if stamped else packet
        _set_vector(pose.position, place.position(data))
        _set_quaternion(pose.orientation, place.orientation(data))

    return fill


def _bind_joint_states(binding: Binding) -> Fill | None:
    """``sensor_msgs/JointState`` of hinges (rad, rad/s, N m) and slides (m, m/s, N).

    Without names: all that have one, in the order of the model. ``effort`` is what the actuators
    apply to the joint.
    """
    model, names = binding.model, binding.declaration.elements
    single = (mujoco.mjtJoint.mjJNT_HINGE.value, mujoco.mjtJoint.mjJNT_SLIDE.value)
    if names:
        joints = [index for _, index in binding.find_all("joint")]
        pointer = f"{binding.declaration.pointer}/element"
        for index in (index for index in joints if model.jnt_type[index] not in single):
            name = names_of(model, "joint")[index]
            binding.problems.add(pointer, f"joint '{name}' is neither a hinge nor a slide")
    else:
        named = enumerate(names_of(model, "joint"))
        joints = [index for index, name in named if name and model.jnt_type[index] in single]
        names = tuple(names_of(model, "joint")[index] for index in joints)
    positions, speeds = model.jnt_qposadr[joints], model.jnt_dofadr[joints]

    def fill(packet: Packet, data: Any, time_ns: int) -> None:
        _set_time(packet.header.stamp, time_ns)
        packet.name = list(names)
        packet.position = array("d", data.qpos[positions].tobytes())
        packet.velocity = array("d", data.qvel[speeds].tobytes())
        packet.effort = array("d", data.qfrc_actuator[speeds].tobytes())

    return fill


class _Touch:
    """The contacts of one geom or body."""

    def __init__(self, model: Any, what: str, index: int) -> None:
        self._model, self._is_geom, self._index = model, what == "geom", index
        geoms = np.arange(model.ngeom)
        self._mine = geoms == index if self._is_geom else model.geom_bodyid[geoms] == index

    def normal_force(self, data: Any) -> float:
        """Sum of the normal forces, newtons."""
        return float(sum(abs(force[0]) for _, _, force in self._contacts(data)))

    def wrench(self, data: Any) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Total force (N) and torque (N m) about the element's origin, along the world's axes."""
        origin = (data.geom_xpos if self._is_geom else data.xpos)[self._index]
        total_force, total_torque = np.zeros(3), np.zeros(3)
        for contact, sign, local in self._contacts(data):
            axes = data.contact.frame[contact].reshape(3, 3)  # rows; the normal is the first
            force, torque = sign * (local[:3] @ axes), sign * (local[3:] @ axes)
            total_force += force
            total_torque += torque + np.cross(data.contact.pos[contact] - origin, force)
        return total_force, total_torque

    def _contacts(self, data: Any) -> Iterator[tuple[int, int, npt.NDArray[np.float64]]]:
        """Contact, sign, and force and torque (6,) in the contact's frame.

        MuJoCo gives what the first geom does to the second, so it counts negatively for the first.
        """
        if not data.ncon:
            return
        pairs = data.contact.geom  # (ncon, 2); -1 where a flex takes part
        mine = (pairs >= 0) & self._mine[pairs]
        for contact in np.flatnonzero(mine[:, 0] != mine[:, 1]).tolist():
            local = np.zeros(6)
            mujoco.mj_contactForce(self._model, data, contact, local)
            yield contact, (-1 if mine[contact, 0] else 1), local


def _bind_contacts(binding: Binding) -> Fill | None:
    """Contacts of a geom, or of the geoms of a body.

    ========================  ==========================================================
    message type              content
    ========================  ==========================================================
    ``std_msgs/Bool``         whether anything presses on the element
    ``std_msgs/Float64``      sum of the normal forces on it, newtons
    ``Float64MultiArray``     this sum for each element of a list, in its order
    ``WrenchStamped``         total force on it (newtons) and torque (N m) about its own
                              origin, both along the axes of the world
    ========================  ==========================================================

    A body stands for its own geoms, not for those of its children. Contacts between geoms of one
    element do not count.
    """
    elements = binding.find_all("geom", "body")
    if len(elements) < len(binding.declaration.elements):
        return None
    touches = [_Touch(binding.model, what, index) for what, index in elements]

    def fill_bool(packet: Any, data: Any, time_ns: int) -> None:
        packet.data = touches[0].normal_force(data) > 0

    def fill_float(packet: Any, data: Any, time_ns: int) -> None:
        packet.data = touches[0].normal_force(data)

    def fill_floats(packet: Any, data: Any, time_ns: int) -> None:
        packet.data = [touch.normal_force(data) for touch in touches]

    def fill_wrench(packet: Any, data: Any, time_ns: int) -> None:
        _set_header(packet.header, time_ns, _WORLD_FRAME)
        force, torque = touches[0].wrench(data)
        _set_vector(packet.wrench.force, force.tolist())
        _set_vector(packet.wrench.torque, torque.tolist())

    return {
        "std_msgs/msg/Bool": fill_bool,
        "std_msgs/msg/Float64": fill_float,
        "std_msgs/msg/Float64MultiArray": fill_floats,
        "geometry_msgs/msg/WrenchStamped": fill_wrench,
    }[binding.declaration.type]


def _bind_camera(binding: Binding) -> Fill | None:
    """``sensor_msgs/Image``, ``rgb8``, of a camera of the model."""
    element = binding.find("camera")
    if element is None:
        return None
    camera, frame = element[1], binding.declaration.elements[0]
    width, height = binding.declaration.width, binding.declaration.height
    cameras = binding.cameras

    def fill(packet: Packet, data: Any, time_ns: int) -> None:
        _set_header(packet.header, time_ns, frame)
        packet.width, packet.height, packet.step = width, height, 3 * width
        packet.encoding = "rgb8"
        # rclpy checks lists and bytes element by element; an array is taken as it is.
        pixels = array("B", (0,)) * (3 * width * height)
        cameras.render(data, camera, np.frombuffer(pixels, np.uint8).reshape(height, width, 3))
        packet.data = pixels

    return fill


def _bind_clock(binding: Binding) -> Fill:
    """``rosgraph_msgs/Clock``: simulated time."""

    def fill(packet: Packet, data: Any, time_ns: int) -> None:
        _set_time(packet.clock, time_ns)

    return fill


SENSOR_KINDS: Mapping[str, SensorKind] = {
    "imu": SensorKind(_bind_imu, ("sensor_msgs/msg/Imu",)),
    "pose": SensorKind(_bind_pose, ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/Pose")),
    "joint_states": SensorKind(
        _bind_joint_states,
        ("sensor_msgs/msg/JointState",),
        "optional",
        ("sensor_msgs/msg/JointState",),
    ),
    "contacts": SensorKind(
        _bind_contacts,
        (
            "std_msgs/msg/Bool",
            "std_msgs/msg/Float64",
            "std_msgs/msg/Float64MultiArray",
            "geometry_msgs/msg/WrenchStamped",
        ),
        list_types=("std_msgs/msg/Float64MultiArray",),
    ),
    "camera": SensorKind(_bind_camera, ("sensor_msgs/msg/Image",), keys=("width", "height")),
    "clock": SensorKind(_bind_clock, ("rosgraph_msgs/msg/Clock",), "none"),
}
