"""What can be measured at a site or body, as MuJoCo's own sensors measure it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import mujoco
import numpy as np

Vector: TypeAlias = "list[float]"
"""3 numbers, or 4 for a quaternion, w first: plain ones, as messages want them."""


class Place:
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
class OwnSensor:
    """A sensor that the model declares: where its reading is, and the square of its ``noise``."""

    start: int
    end: int
    variance: float

    def read(self, data: Any) -> Vector:
        return _plain(data.sensordata[self.start : self.end])


def own_sensor(model: Any, sensor_type: Any, place: Place) -> OwnSensor | None:
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
            return OwnSensor(start, end, float(model.sensor_noise[index]) ** 2)
    return None
