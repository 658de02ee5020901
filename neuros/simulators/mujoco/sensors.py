"""From MuJoCo's data to ROS messages: one function per kind of sensor.

Each ``bind_...`` looks its elements up once, by name, and returns a function that fills a packet
from the data, as they are right after ``mj_forward``; that function is all that runs at a firing.

Where the model has a sensor of its own at the element (``gyro``, ``accelerometer``, ``framequat``),
its reading is taken, with its cutoff. Otherwise the same quantity is computed from the data, as
MuJoCo's sensors compute it.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import mujoco
import numpy as np

from neuros.ports import Packet
from neuros.simulators.mujoco.cameras import Cameras
from neuros.simulators.mujoco.contacts import contact_filler
from neuros.simulators.mujoco.declarations import Problems, SensorDeclaration
from neuros.simulators.mujoco.elements import find, names_of
from neuros.simulators.mujoco.places import Place, Vector, own_sensor

Fill: TypeAlias = Callable[[Packet, Any, int], None]
"""``fill(packet, data, time_ns)``."""

_WORLD_FRAME = "world"


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


def bind(binding: Binding) -> Fill | None:
    """The function that fills the packets of a sensor; ``None`` after reporting a problem."""
    return _BINDERS[binding.declaration.kind](binding)


def set_time(time: Any, time_ns: int) -> None:
    """Set a ``builtin_interfaces/Time``."""
    time.sec, time.nanosec = divmod(time_ns, 1_000_000_000)


def _set_header(header: Any, time_ns: int, frame: str) -> None:
    set_time(header.stamp, time_ns)
    header.frame_id = frame


def _set_vector(vector: Any, values: Vector) -> None:
    vector.x, vector.y, vector.z = values


def _set_quaternion(quaternion: Any, values: Vector) -> None:
    """ROS writes the real part last, MuJoCo first."""
    quaternion.w, quaternion.x, quaternion.y, quaternion.z = values


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
    place = Place(model, *element)
    gyro = own_sensor(model, mujoco.mjtSensor.mjSENS_GYRO, place)
    accelerometer = own_sensor(model, mujoco.mjtSensor.mjSENS_ACCELEROMETER, place)
    orientation = own_sensor(model, mujoco.mjtSensor.mjSENS_FRAMEQUAT, place)

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
    place = Place(binding.model, *element)
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
        set_time(packet.header.stamp, time_ns)
        packet.name = list(names)
        packet.position = array("d", data.qpos[positions].tobytes())
        packet.velocity = array("d", data.qvel[speeds].tobytes())
        packet.effort = array("d", data.qfrc_actuator[speeds].tobytes())

    return fill


def _bind_contacts(binding: Binding) -> Fill | None:
    """Touch of a geom, or of all geoms of a body; see :mod:`neuros.simulators.mujoco.contacts`."""
    elements = binding.find_all("geom", "body")
    if len(elements) < len(binding.declaration.elements):
        return None
    return contact_filler(binding.model, elements, binding.declaration.type, _WORLD_FRAME, set_time)


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
        set_time(packet.clock, time_ns)

    return fill


_BINDERS: Mapping[str, Callable[[Binding], Fill | None]] = {
    "imu": _bind_imu,
    "pose": _bind_pose,
    "joint_states": _bind_joint_states,
    "contacts": _bind_contacts,
    "camera": _bind_camera,
    "clock": _bind_clock,
}
