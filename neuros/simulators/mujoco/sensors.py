"""Sensors: a class each, with the keys of its declaration, the units, and how it fills a message.

To add one, write a subclass of :class:`Sensor` here and name it in :data:`SENSORS`; then
:func:`write_schema` puts it into the schema of node files.

Declarations are read and checked without a model, and all problems are gathered. A sensor finds its
elements once, by name, and fills packets from the data, after ``mj_forward`` if it needs that.
Where the model has a sensor at the element (``gyro``, ``accelerometer``, ``framequat``) its reading
is used, with its cutoff; otherwise the quantity is computed as MuJoCo's sensors compute it.
Distances are metres. As in REP 117, ``inf`` is "nothing within range", ``-inf`` "too close".
"""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import mujoco
import numpy as np
import numpy.typing as npt

from neuros.ports import Packet
from neuros.project.model import Node, Port
from neuros.project.timing import seeds
from neuros.project.validate import SCHEMA_FOLDER, schema
from neuros.simulators.mujoco.cameras import Cameras
from neuros.simulators.mujoco.lookup import (
    Faults,
    Problems,
    did_you_mean,
    form_of,
    is_list_of_names,
    names_of,
)
from neuros.simulators.mujoco.readings import Data, Reading, Transforms
from neuros.simulators.mujoco.sensor_base import (
    DEVIATION,
    PICTURE,
    WORLD_FRAME,
    Frame,
    Key,
    Noise,
    Sensor,
    SensorDeclaration,
    Vector,
    listed,
    set_header,
    set_quaternion,
    set_vector,
)
from neuros.time import set_stamp

_POINT_BYTES = 12


@dataclass(frozen=True)
class _OwnSensor:
    """A sensor that the model declares: its slice of ``sensordata``, and ``noise`` squared."""

    start: int
    end: int
    variance: float

    def read(self, data: Any) -> Vector:
        return listed(data.sensordata[self.start : self.end])


def _own_sensor(model: Any, sensor_type: Any, place: Frame) -> _OwnSensor | None:
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


class _Touch:
    """The contacts of one geom or body."""

    def __init__(self, model: Any, sort: str, index: int) -> None:
        self._model, self._is_geom, self._index = model, sort == "geom", index
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
        """The number of each contact, its sign, and force and torque (6,) in the contact's frame.

        MuJoCo's force is the one that the first geom exerts on the second: its sign is -1 for the
        first.
        """
        if not data.ncon:
            return
        pairs = data.contact.geom  # (ncon, 2); -1 where a flex takes part
        mine = (pairs >= 0) & self._mine[pairs]
        for contact in np.flatnonzero(mine[:, 0] != mine[:, 1]).tolist():
            local = np.zeros(6)
            mujoco.mj_contactForce(self._model, data, contact, local)
            yield contact, (-1 if mine[contact, 0] else 1), local


class Imu(Sensor):
    """An IMU at a site or body, in its frame, as in REP 145.

    ``linear_acceleration`` (m/s^2) includes gravity: +9.81 upwards at rest, 0 in free fall.
    ``angular_velocity`` in rad/s, with the declared ``noise`` (rad/s) and a bias that drifts by
    ``bias_drift`` (rad/s per square root of a second); ``orientation`` of the element in the world.
    Covariances: the square of the declared ``noise``, and of that of the model's own sensor, which
    MuJoCo does not add to readings, on the diagonal; else zeros ("unknown").
    """

    kind = "imu"
    types = ("sensor_msgs/msg/Imu",)
    sorts = ("site", "body")
    keys: ClassVar[Mapping[str, Key]] = MappingProxyType(
        {"noise": DEVIATION, "bias_drift": DEVIATION}
    )

    def bind(self, problems: Problems) -> None:
        self._place = place = Frame(self.model, *self.elements[0])
        kinds = mujoco.mjtSensor
        self._gyro = _own_sensor(self.model, kinds.mjSENS_GYRO, place)
        self._accelerometer = _own_sensor(self.model, kinds.mjSENS_ACCELEROMETER, place)
        self._orientation = _own_sensor(self.model, kinds.mjSENS_FRAMEQUAT, place)

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        place, gyro, accelerometer = self._place, self._gyro, self._accelerometer
        orientation = self._orientation
        set_header(packet.header, time_ns, self.declared.elements[0])
        velocity = gyro.read(data) if gyro else place.angular_velocity(data)
        acceleration = accelerometer.read(data) if accelerometer else place.acceleration(data)
        attitude = orientation.read(data) if orientation else place.orientation(data)
        if self.noise.is_on:
            velocity = listed(self.noise.of(velocity))
        set_vector(packet.angular_velocity, velocity)
        set_vector(packet.linear_acceleration, acceleration)
        set_quaternion(packet.orientation, attitude)
        variance = self.noise.deviation**2 + (gyro.variance if gyro else 0.0)
        if variance:
            packet.angular_velocity_covariance[::4] = variance
        if accelerometer:
            packet.linear_acceleration_covariance[::4] = accelerometer.variance
        if orientation:
            packet.orientation_covariance[::4] = orientation.variance


class Pose(Sensor):
    """Pose of a site or body in the world, in metres."""

    kind = "pose"
    types = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/Pose")
    sorts = ("site", "body")

    def bind(self, problems: Problems) -> None:
        self._place = Frame(self.model, *self.elements[0])
        self._is_stamped = self.declared.type.endswith("Stamped")

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        if self._is_stamped:
            set_header(packet.header, time_ns, WORLD_FRAME)
        pose = packet.pose if self._is_stamped else packet
        set_vector(pose.position, self._place.position(data))
        set_quaternion(pose.orientation, self._place.orientation(data))


class JointStates(Sensor):
    """Joints, all that have a name if no element is given.

    Hinges (rad, rad/s, N m) and slides (m, m/s, N). Without names the order is that of the model.
    ``effort`` is what the actuators apply to the joint.
    """

    kind = "joint_states"
    types = list_types = ("sensor_msgs/msg/JointState",)
    sorts = ("joint",)
    is_optional = True

    def bind(self, problems: Problems) -> None:
        names, types = names_of(self.model, "joint"), self.model.jnt_type
        single = (mujoco.mjtJoint.mjJNT_HINGE.value, mujoco.mjtJoint.mjJNT_SLIDE.value)
        joints = [index for _, index in self.elements]
        if not joints:
            joints = [i for i, name in enumerate(names) if name and types[i] in single]
        for index in joints:
            if types[index] not in single:
                text = f"joint '{names[index]}' is neither a hinge nor a slide"
                problems.add(f"{self.declared.pointer}/element", text)
        self._names = [names[index] for index in joints]
        self._positions = self.model.jnt_qposadr[joints]
        self._speeds = self.model.jnt_dofadr[joints]

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        set_stamp(packet.header.stamp, time_ns)
        packet.name = self._names.copy()
        packet.position = array("d", data.qpos[self._positions].tobytes())
        packet.velocity = array("d", data.qvel[self._speeds].tobytes())
        packet.effort = array("d", data.qfrc_actuator[self._speeds].tobytes())


class Contacts(Sensor):
    """Contacts of a geom or body; of a list of them into a Float64MultiArray.

    ========================  ==========================================================
    message type              content
    ========================  ==========================================================
    ``std_msgs/Bool``         whether anything presses on the element
    ``std_msgs/Float64``      sum of the normal forces on it, newtons
    ``Float64MultiArray``     this sum for each element of a list, in its order; an array, too
    ``WrenchStamped``         total force on it (newtons) and torque (N m) about its own
                              origin, both along the axes of the world
    ========================  ==========================================================

    A body stands for its own geoms, not for those of its children. Contacts between geoms of one
    element do not count.
    """

    kind = "contacts"
    types = (
        "std_msgs/msg/Bool",
        "std_msgs/msg/Float64",
        "std_msgs/msg/Float64MultiArray",
        "float64[...]",
        "geometry_msgs/msg/WrenchStamped",
    )
    list_types = ("std_msgs/msg/Float64MultiArray", "float64[...]")
    sorts = ("geom", "body")

    def bind(self, problems: Problems) -> None:
        self._touches = [_Touch(self.model, *element) for element in self.elements]
        self.check_array(problems, "the forces", len(self._touches))

    def fill_array(self, packet: Packet, data: Any) -> None:
        packet.flat[:] = [each.normal_force(data) for each in self._touches]

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        touch = self._touches[0]
        match self.declared.type:
            case "std_msgs/msg/Bool":
                packet.data = touch.normal_force(data) > 0
            case "std_msgs/msg/Float64":
                packet.data = touch.normal_force(data)
            case "std_msgs/msg/Float64MultiArray":
                packet.data = [each.normal_force(data) for each in self._touches]
            case "geometry_msgs/msg/WrenchStamped":
                set_header(packet.header, time_ns, WORLD_FRAME)
                force, torque = touch.wrench(data)
                set_vector(packet.wrench.force, force.tolist())
                set_vector(packet.wrench.torque, torque.tolist())


class Lidar(Sensor):
    """A laser scanner at a site or body: beams in its x-y plane, counter-clockwise, 0 along x.

    Geoms of the element's own body are not seen.
    """

    kind = "lidar"
    types = ("sensor_msgs/msg/LaserScan", "float32[...]")
    sorts = ("site", "body")
    axes = ("beams",)
    keys: ClassVar[Mapping[str, Key]] = MappingProxyType(
        {
            "beams": Key(360, "a number of beams from 2 to 100000", True, 2, 100_000),
            "angle_min": Key(-math.pi, "an angle in radians"),
            "angle_max": Key(math.pi, "an angle in radians"),
            "range_min": Key(0.0, "a distance in metres", least=0.0),
            "range_max": Key(10.0, "a distance in metres", least=0.0),
        }
    )

    def bind(self, problems: Problems) -> None:
        sort, index = self.elements[0]
        self._is_site = sort == "site"
        self._index = index
        self._body = int(self.model.site_bodyid[index]) if self._is_site else index
        options = self.declared.options
        for low, high in (("angle_min", "angle_max"), ("range_min", "range_max")):
            if not options[low] < options[high]:
                text = f"{options[high]:g} is not above {low}, which is {options[low]:g}"
                problems.add(f"{self.declared.pointer}/{high}", text)
        angles = np.linspace(options["angle_min"], options["angle_max"], int(options["beams"]))
        self._beams = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
        self.check_array(problems, "the ranges", len(angles))

    def fill_array(self, packet: Packet, data: Any) -> None:
        packet.flat[:] = self._ranges(data)

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        options, count = self.declared.options, len(self._beams)
        set_header(packet.header, time_ns, self.declared.elements[0])
        packet.angle_min, packet.angle_max = options["angle_min"], options["angle_max"]
        packet.angle_increment = (packet.angle_max - packet.angle_min) / (count - 1)
        packet.scan_time = 1 / self.declared.rate_hz
        packet.range_min, packet.range_max = options["range_min"], options["range_max"]
        packet.ranges = array("f", self._ranges(data).tobytes())

    def _ranges(self, data: Any) -> npt.NDArray[np.float32]:
        """Shape (beams,), in metres."""
        options, count = self.declared.options, len(self._beams)
        origins, axes = (data.xpos, data.xmat)
        if self._is_site:
            origins, axes = data.site_xpos, data.site_xmat
        beams = self._beams @ axes[self._index].reshape(3, 3).T
        found, hit = np.empty(count), np.empty(count, np.int32)
        mujoco.mj_multiRay(
            *(self.model, data, origins[self._index], beams.ravel(), None, 1, self._body),
            *(hit, found, None, count, options["range_max"]),
        )
        found[(found < 0) | (found > options["range_max"])] = np.inf
        found[found < options["range_min"]] = -np.inf
        return found.astype(np.float32)


class _Pinhole(Sensor):
    """A camera of the model as a pinhole: its intrinsic matrix, in pixels."""

    sorts = ("camera",)
    keys = PICTURE

    def bind(self, problems: Problems) -> None:
        model, camera = self.model, self.elements[0][1]
        if model.cam_projection[camera] != mujoco.mjtProjection.mjPROJ_PERSPECTIVE.value:
            text = "an orthographic camera is no pinhole: it has no depth and no camera info"
            problems.add(f"{self.declared.pointer}/element", text)
        width, height = self.declared.width, self.declared.height
        sensor_m = model.cam_sensorsize[camera]
        # The middle of the first pixel is 0, as in OpenCV.
        self._cx, self._cy = (width - 1) / 2, (height - 1) / 2
        if sensor_m[1]:
            fx_m, fy_m, cx_m, cy_m = model.cam_intrinsic[camera].tolist()
            self._fx, self._fy = fx_m / sensor_m[0] * width, fy_m / sensor_m[1] * height
            self._cx -= cx_m / sensor_m[0] * width
            self._cy -= cy_m / sensor_m[1] * height
        else:
            half = math.radians(float(model.cam_fovy[camera])) / 2
            self._fx = self._fy = height / 2 / math.tan(half)


class CameraInfo(_Pinhole):
    """The geometry of a camera: a pinhole without distortion, as image_pipeline has it."""

    kind = "camera_info"
    types = ("sensor_msgs/msg/CameraInfo",)

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        set_header(packet.header, time_ns, self.declared.elements[0])
        packet.width, packet.height = self.declared.width, self.declared.height
        packet.distortion_model, packet.d = "plumb_bob", [0.0] * 5
        fx, fy, cx, cy = self._fx, self._fy, self._cx, self._cy
        packet.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        packet.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        packet.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]


class Depth(_Pinhole):
    """Depth of a camera's pixels: an image (32FC1, along the optical axis), or points in its frame.

    Points are rows of x (right), y (down) and z (forward), as many as pixels; NaN where nothing is.
    """

    kind = "depth"
    types = ("sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2", "float32[...]")
    axes = ("height", "width")
    is_rendered = True

    def bind(self, problems: Problems) -> None:
        super().bind(problems)
        width, height = self.declared.width, self.declared.height
        self._right = (np.arange(width, dtype=np.float32) - self._cx) / self._fx
        self._down = ((np.arange(height, dtype=np.float32) - self._cy) / self._fy)[:, None]
        self.check_array(problems, "height and width", height, width)

    def fill_array(self, packet: Packet, data: Any) -> None:
        declared = self.declared
        packet[:] = self.cameras.depth(data, self.elements[0][1], declared.width, declared.height)

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        width, height = self.declared.width, self.declared.height
        set_header(packet.header, time_ns, self.declared.elements[0])
        depth = self.cameras.depth(data, self.elements[0][1], width, height)
        packet.width, packet.height = width, height
        if self.declared.type.endswith("Image"):
            packet.encoding, packet.step = "32FC1", 4 * width
            packet.data = array("B", depth.tobytes())
            return
        from sensor_msgs.msg import PointField

        packet.point_step, packet.row_step = _POINT_BYTES, _POINT_BYTES * width
        packet.fields = [
            PointField(name=name, offset=4 * place, datatype=PointField.FLOAT32, count=1)
            for place, name in enumerate("xyz")
        ]
        packet.data = array("B", self._points(depth).tobytes())

    def _points(self, depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Shape (height, width, 3)."""
        forward = np.where(np.isfinite(depth), depth, np.float32(np.nan))
        points = [self._right * forward, self._down * forward, forward]
        return np.stack(points, axis=-1).astype(np.float32)


class Camera(Sensor):
    """A camera of the model, rgb8; into an array: rows, columns and the three colours.

    Each colour of each pixel has noise of its own, ``noise`` of 255 grey levels.
    """

    kind = "camera"
    types = ("sensor_msgs/msg/Image", "uint8[...]")
    sorts = ("camera",)
    keys: ClassVar[Mapping[str, Key]] = MappingProxyType({**PICTURE, "noise": DEVIATION})
    axes = ("height", "width")
    is_rendered = True

    def bind(self, problems: Problems) -> None:
        self.check_array(problems, "pixels", self.declared.height, self.declared.width, 3)

    def fill_array(self, packet: Packet, data: Any) -> None:
        self.cameras.render(data, self.elements[0][1], packet)
        if self.noise.is_on:
            packet[:] = np.rint(np.clip(self.noise.of(packet), 0, 255))

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        width, height = self.declared.width, self.declared.height
        set_header(packet.header, time_ns, self.declared.elements[0])
        packet.width, packet.height, packet.step = width, height, 3 * width
        packet.encoding = "rgb8"
        # rclpy checks lists and bytes element by element, but not arrays.
        pixels = array("B", (0,)) * (3 * width * height)
        image = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
        self.fill_array(image, data)
        packet.data = pixels


class Clock(Sensor):
    """Simulated time."""

    kind = "clock"
    types = ("rosgraph_msgs/msg/Clock",)
    needs_forward = False

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        set_stamp(packet.clock, time_ns)


SENSORS: Mapping[str, type[Sensor]] = {
    sensor.kind: sensor
    for sensor in (
        *(Imu, Pose, JointStates, Contacts, Reading, Data, Lidar, Depth, CameraInfo, Transforms),
        *(Camera, Clock),
    )
}


# ---- declarations


def read_sensors(node: Node, problems: Problems) -> tuple[SensorDeclaration, ...]:
    """The sensors that the outputs of ``node`` declare; faulty ones are left out and reported."""
    found = (
        _sensor(node, port, f"{node.pointer}/outputs/{index}/mujoco", problems)
        for index, port in enumerate(node.outputs)
        if port.mujoco
    )
    return tuple(sensor for sensor in found if sensor)


def _sensor(node: Node, port: Port, pointer: str, problems: Problems) -> SensorDeclaration | None:
    faults, name = Faults(pointer, problems), port.mujoco.get("sensor")
    sensor = SENSORS.get(name) if isinstance(name, str) else None
    if sensor is None:
        hint = did_you_mean(str(name or ""), SENSORS)
        faults.add("sensor", f"{name!r} is not a kind of sensor{hint}")
        return None
    faults.unknown_keys(port.mujoco, ("sensor", "element", "rate", *sensor.keys))
    if form_of(port.type) not in sensor.types:
        types = " or ".join(sensor.types)
        faults.add("sensor", f"'{name}' fills {types}, but output '{port.name}' is a {port.type}")
    elements = _elements(port, sensor, faults)
    rate: Any = port.mujoco.get("rate")
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0 < rate < float("inf"):
        faults.add("rate", f"{rate!r} is not a positive number (firings per simulated second)")
    shape = port.array.shape if port.array else ()
    defaults = {key: sensor.keys[key].default for key in sensor.keys}
    defaults |= dict(zip(sensor.axes, shape, strict=False))
    options = {key: port.mujoco.get(key, defaults[key]) for key in sensor.keys}
    number = len(seeds([node]).get(node.name, {}))
    for key, value in options.items():
        if not sensor.keys[key].holds(value):
            faults.add(key, f"{value!r} is not {sensor.keys[key].what}")
        elif value and sensor.keys[key] is DEVIATION and number != 1:
            has = "several" if number else "none"
            text = "noise needs a seed: one variable with SEED in its name in the environment"
            faults.add(key, f"{text} of node '{node.name}', which has {has}")
    if faults.found:
        return None
    return SensorDeclaration(
        port.name, port.type, sensor.kind, elements, float(rate), pointer, options
    )


def _elements(port: Port, sensor: type[Sensor], faults: Faults) -> tuple[str, ...]:
    value = port.mujoco.get("element")
    if value is None:
        if sensor.sorts and not sensor.is_optional:
            faults.add("element", "missing: name the element of the model that is measured")
    elif not sensor.sorts:
        faults.add("element", f"a {sensor.kind} measures no element: leave this key out")
    elif isinstance(value, str):
        return (value,)
    elif not is_list_of_names(value):
        faults.add("element", f"{value!r} is neither a name nor a list of names")
    elif form_of(port.type) not in sensor.list_types:
        hint = f"; a list needs {' or '.join(sensor.list_types)}" if sensor.list_types else ""
        faults.add("element", f"a {port.type} holds one element only{hint}")
    else:
        return tuple(value)
    return ()


def bind_sensors(
    model: Any,
    declared: Iterable[SensorDeclaration],
    cameras: Cameras,
    noises: Mapping[str, Noise],
    problems: Problems,
) -> dict[str, Sensor]:
    """The sensor behind each output; problems are reported."""
    return {
        each.output: SENSORS[each.kind](each, model, cameras, noises[each.output], problems)
        for each in declared
    }


# ---- schema


def with_sensors(node_schema: Mapping[str, Any]) -> dict[str, Any]:
    """The schema of node files, with all kinds of sensors."""
    part = dict(node_schema["$defs"]["mujoco_sensor"])
    properties = dict(part["properties"])
    summaries = {kind: (each.__doc__ or "").splitlines()[0] for kind, each in SENSORS.items()}
    kinds = (f"{s.kind} ({' or '.join(s.types)}): {summaries[s.kind]}" for s in SENSORS.values())
    properties["sensor"] = properties["sensor"] | {
        "description": " ".join(kinds),
        "enum": list(SENSORS),
    }
    rules = [_rule(sensor, summaries[kind]) for kind, sensor in SENSORS.items()]
    part |= {"properties": properties, "allOf": rules}
    return {**node_schema, "$defs": {**node_schema["$defs"], "mujoco_sensor": part}}


def _rule(sensor: type[Sensor], summary: str) -> dict[str, Any]:
    """The schema of declarations of this kind."""
    element: dict[str, Any] = {"type": ["string", "array"] if sensor.list_types else "string"}
    keys = dict.fromkeys(key for each in SENSORS.values() for key in each.keys)
    then: dict[str, Any] = {
        "description": summary,
        "properties": {
            "element": element if sensor.sorts else {"not": {}},
            **{key: {"not": {}} for key in keys if key not in sensor.keys},
        },
    }
    if sensor.sorts and not sensor.is_optional:
        then["required"] = ["element"]
    kind = {"properties": {"sensor": {"const": sensor.kind}}, "required": ["sensor"]}
    return {"if": kind, "then": then}


def write_schema() -> None:
    """Write the sensors into ``schema/node.schema.json``."""
    text = json.dumps(with_sensors(schema("node")), indent=2, ensure_ascii=False)
    (SCHEMA_FOLDER / "node.schema.json").write_text(f"{text}\n", "utf-8")
