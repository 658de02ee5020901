"""Readings of the sensors that a model declares itself, arrays of ``mjData``, and transforms."""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

from neuros.ports import Packet
from neuros.simulators.mujoco.lookup import Problems, did_you_mean, names_of
from neuros.simulators.mujoco.sensor_base import (
    WORLD_FRAME,
    Sensor,
    Vector,
    listed,
    set_header,
    set_quaternion,
    set_vector,
)

_OPTICAL = np.array([0.0, 1.0, 0.0, 0.0])
"""From the axes of MuJoCo's cameras (y up, looking along -z) to those of REP 103 (y down, z)."""
_FLOATS = "std_msgs/msg/Float64MultiArray"
_ARRAYS = ("float64[...]", "float32[...]")
# These sensors measure at a site, along its axes.
_LOCAL = {"accelerometer", "velocimeter", "gyro", "force", "torque", "magnetometer", "rangefinder"}
_INFRARED = 1


class _Form(NamedTuple):
    """How a message type holds a reading.

    Attributes:
        numbers: how many numbers it holds.
        put: writes them into a message.
        kinds: the kinds of MuJoCo sensors that fit; empty: any with that many numbers.
    """

    numbers: int
    put: Callable[[Packet, Vector, Reading], object]
    kinds: tuple[str, ...] = ()


def _put_field(packet: Packet, values: Vector, sensor: Reading) -> None:
    set_vector(packet.magnetic_field, values)
    packet.magnetic_field_covariance[::4] = sensor.deviation**2


def _put_range(packet: Packet, values: Vector, sensor: Reading) -> None:
    packet.radiation_type = _INFRARED
    packet.max_range = sensor.cutoff or float("inf")
    # MuJoCo writes -1 where nothing is hit, REP 117 +inf.
    packet.range = values[0] if values[0] >= 0 else float("inf")


_FORMS: Mapping[str, _Form] = {
    "std_msgs/msg/Float64": _Form(1, lambda p, v, _: setattr(p, "data", v[0])),
    "sensor_msgs/msg/Range": _Form(1, _put_range, ("rangefinder",)),
    "geometry_msgs/msg/Vector3": _Form(3, lambda p, v, _: set_vector(p, v)),
    "geometry_msgs/msg/Vector3Stamped": _Form(3, lambda p, v, _: set_vector(p.vector, v)),
    "geometry_msgs/msg/PointStamped": _Form(
        3, lambda p, v, _: set_vector(p.point, v), ("framepos", "subtreecom")
    ),
    "geometry_msgs/msg/WrenchStamped": _Form(
        3,
        lambda p, v, sensor: set_vector(getattr(p.wrench, sensor.kinds[0]), v),
        ("force", "torque"),
    ),
    "sensor_msgs/msg/MagneticField": _Form(3, _put_field, ("magnetometer",)),
    "geometry_msgs/msg/Quaternion": _Form(4, lambda p, v, _: set_quaternion(p, v)),
    "geometry_msgs/msg/QuaternionStamped": _Form(
        4, lambda p, v, _: set_quaternion(p.quaternion, v)
    ),
}


class Reading(Sensor):
    """The reading of a sensor of the model (MJCF's sensor); a list of them: all their numbers.

    Units and axes are MuJoCo's; ``gyro`` and the like measure along the axes of their site.
    ``force`` and ``torque`` fill their half of a WrenchStamped: the load of a child on its parent.
    A Float64MultiArray, or an array, holds any sensor. MuJoCo adds no noise.

    Attributes:
        kinds: MuJoCo's kind of each sensor, as ``"gyro"``.
        deviation, cutoff: of the first sensor; the deviation is its ``noise``.
    """

    kind = "reading"
    types = (_FLOATS, *_ARRAYS, *_FORMS)
    list_types = (_FLOATS, *_ARRAYS)
    sorts = ("sensor",)

    def bind(self, problems: Problems) -> None:
        model, indices = self.model, [index for _, index in self.elements]
        self._places = [
            slice(int(model.sensor_adr[i]), int(model.sensor_adr[i] + model.sensor_dim[i]))
            for i in indices
        ]
        self.kinds: list[str] = [
            mujoco.mjtSensor(int(model.sensor_type[i])).name.removeprefix("mjSENS_").lower()
            for i in indices
        ]
        self.deviation = float(model.sensor_noise[indices[0]])
        self.cutoff = float(model.sensor_cutoff[indices[0]])
        self._frame = self._frame_of(indices[0])
        self._form = _FORMS.get(self.declared.type)
        count = int(model.sensor_dim[indices[0]])
        self.check_array(problems, "the readings", sum(int(model.sensor_dim[i]) for i in indices))
        fitting = [name for name, form in _FORMS.items() if self._fits(form, count)]
        if self._form is not None and self.declared.type not in fitting:
            numbers = "1 number" if count == 1 else f"{count} numbers"
            problems.add(
                f"{self.declared.pointer}/element",
                f"the {self.kinds[0]} '{self.declared.elements[0]}' measures {numbers}, which fill"
                f" {' or '.join([*fitting, _FLOATS])}, but output '{self.declared.output}' is a"
                f" {self.declared.type}",
            )

    def fill_array(self, packet: Packet, data: Any) -> None:
        parts = [data.sensordata[place] for place in self._places]
        np.concatenate(parts, out=packet.reshape(-1), casting="same_kind")

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        if self._form is None:
            values = np.concatenate([data.sensordata[place] for place in self._places])
            packet.data = array("d", values.tobytes())
            return
        if hasattr(packet, "header"):
            set_header(packet.header, time_ns, self._frame)
        self._form.put(packet, listed(data.sensordata[self._places[0]]), self)

    def _fits(self, form: _Form, count: int) -> bool:
        return form.numbers == count and (not form.kinds or self.kinds[0] in form.kinds)

    def _frame_of(self, index: int) -> str:
        """The frame along whose axes the sensor measures; empty where it has none."""
        model, kind = self.model, self.kinds[0]
        if kind in _LOCAL:
            sort, element = model.sensor_objtype[index], model.sensor_objid[index]
        elif not kind.startswith(("frame", "subtree")):
            return ""
        elif model.sensor_refid[index] < 0:
            return WORLD_FRAME
        else:
            sort, element = model.sensor_reftype[index], model.sensor_refid[index]
        return mujoco.mj_id2name(model, int(sort), int(element)) or ""


STATE = (
    *("time", "qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos"),
    *("mocap_quat", "userdata"),
)
"""Arrays of ``mjData`` that belong to the state of a step, or are set from outside."""
_COMPUTED = (
    *("qacc", "act_dot", "sensordata", "energy", "actuator_force", "actuator_length"),
    *("actuator_velocity", "qfrc_actuator", "qfrc_bias", "qfrc_passive", "qfrc_constraint"),
    *("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos", "geom_xmat"),
    *("site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "subtree_com", "cinert", "cvel"),
    *("ten_length", "ten_velocity", "cacc", "cfrc_int", "cfrc_ext"),
)
AFTER_CONSTRAINT = {"cacc", "cfrc_int", "cfrc_ext"}
_SLICE = re.compile(r"(\w+)(?:\[(-?\d{1,9})?:(-?\d{1,9})?\])?", re.ASCII)


class Data(Sensor):
    """Arrays of MuJoCo's mjData by their names (qpos, qvel, sensordata), or a list of them.

    All their numbers follow each other, row by row. ``qpos[2:]`` is a part of an array, as in
    Python. Units are MuJoCo's.
    """

    kind = "data"
    types = list_types = _ARRAYS
    sorts = ("array of mjData",)

    def find(self, name: str, problems: Problems) -> tuple[str, int] | None:
        field = field_of(name)
        if field is None:
            problems.add(f"{self.declared.pointer}/element", no_field(name))
            return None
        return field, 0

    def bind(self, problems: Problems) -> None:
        names = [name for name, _ in self.elements]
        self.needs_forward = not {*names} <= {*STATE}
        self._is_after_constraint = not {*names}.isdisjoint(AFTER_CONSTRAINT)
        self._time = np.zeros(1)
        self._data: Any = None
        count = sum(part.size for part in self._parts_of(mujoco.MjData(self.model)))
        self.check_array(problems, ", ".join(self.declared.elements), count)

    def fill_array(self, packet: Packet, data: Any) -> None:
        if data is not self._data:
            self._data, self._parts = data, self._parts_of(data)
        self._time[0] = data.time
        if self._is_after_constraint:
            compute_forces(self.model, data)
        np.concatenate(self._parts, out=packet.reshape(-1), casting="same_kind")

    def _parts_of(self, data: Any) -> list[Any]:
        return [part_of(data, name, self._time) for name in self.declared.elements]


def field_of(name: str) -> str | None:
    """The array of mjData that a name like ``qpos[2:]`` is about; ``None`` if it is about none."""
    match = _SLICE.fullmatch(name)
    return match[1] if match is not None and match[1] in (*STATE, *_COMPUTED) else None


def part_of(data: Any, name: str, time: Any) -> Any:
    """A view of an array of mjData, or of a part of it, as one row.

    Args:
        data: the ``mujoco.MjData``.
        name: one that :func:`field_of` knows.
        time: an array of one number, which stands for the time: that is no array in mjData.
    """
    match = _SLICE.fullmatch(name)
    assert match is not None
    whole = time if match[1] == "time" else getattr(data, match[1])
    first, end = (int(each) if each else None for each in match.groups()[1:])
    return whole[first:end].reshape(-1)


def compute_forces(model: Any, data: Any) -> None:
    """Compute :data:`AFTER_CONSTRAINT`, as mj_forward does if a sensor of the model needs it."""
    if not getattr(data, "flg_rnepost", False):
        mujoco.mj_rnePostConstraint(model, data)


def no_field(name: str) -> str:
    """The problem with a name that :func:`field_of` does not know."""
    match = _SLICE.fullmatch(name)
    hint = did_you_mean(match[1] if match else name, (*STATE, *_COMPUTED))
    return f"'{name}' is neither an array of mjData nor a part of one, as 'qpos[2:]'{hint}"


class Transforms(Sensor):
    """Transforms of bodies, sites and cameras, for /tf; of all named bodies if none is given.

    The parent of each is the nearest listed body above it, else ``world``. A camera's frame is the
    optical one of REP 103, like that of its pictures: z forward, x right, y down.
    """

    kind = "tf"
    types = list_types = ("tf2_msgs/msg/TFMessage",)
    sorts = ("body", "site", "camera")
    is_optional = True

    def bind(self, problems: Problems) -> None:
        model, bodies = self.model, names_of(self.model, "body")
        elements = self.elements or [("body", i) for i, name in enumerate(bodies) if i and name]
        self._elements = elements
        self._names = list(self.declared.elements) or [bodies[index] for _, index in elements]
        places = {index: place for place, (sort, index) in enumerate(elements) if sort == "body"}
        self._parents: list[int | None] = []
        for sort, index in elements:
            above = index if sort == "body" else -1
            body = {"site": model.site_bodyid, "camera": model.cam_bodyid}.get(sort)
            body = int(model.body_parentid[index] if body is None else body[index])
            while body and (body not in places or body == above):
                body = int(model.body_parentid[body])
            self._parents.append(places.get(body) if body else None)

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        from geometry_msgs.msg import TransformStamped

        poses = [self._pose(data, sort, index) for sort, index in self._elements]
        for name, parent, (position, turned) in zip(self._names, self._parents, poses, strict=True):
            stamped = TransformStamped(child_frame_id=name)
            frame = WORLD_FRAME if parent is None else self._names[parent]
            set_header(stamped.header, time_ns, frame)
            if parent is not None:
                at, back = np.zeros(3), np.zeros(4)
                mujoco.mju_negPose(at, back, *poses[parent])
                moved, rotated = np.zeros(3), np.zeros(4)
                mujoco.mju_mulPose(moved, rotated, at, back, position, turned)
                position, turned = moved, rotated
            set_vector(stamped.transform.translation, listed(position))
            set_quaternion(stamped.transform.rotation, listed(turned))
            packet.transforms.append(stamped)

    def _pose(self, data: Any, sort: str, index: int) -> tuple[Any, Any]:
        if sort == "body":
            return data.xpos[index], data.xquat[index]
        turned = np.zeros(4)
        if sort == "site":
            mujoco.mju_mat2Quat(turned, data.site_xmat[index])
            return data.site_xpos[index], turned
        optical = np.zeros(4)
        mujoco.mju_mat2Quat(turned, data.cam_xmat[index])
        mujoco.mju_mulQuat(optical, turned, _OPTICAL)
        return data.cam_xpos[index], optical
