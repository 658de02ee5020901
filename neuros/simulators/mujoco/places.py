"""What can be measured at a site or body, as MuJoCo's own sensors measure it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt

Vector: TypeAlias = "npt.NDArray[np.float64]"
"""Shape (3,), or (4,) for a quaternion, w first."""


class Place:
    """The frame of a site, or of a body (its own frame, not the one of its inertia)."""

    def __init__(self, model: Any, what: str, index: int) -> None:
        self._model, self._is_site, self.index = model, what == "site", index
        objects = mujoco.mjtObj
        self.object = (objects.mjOBJ_SITE if self._is_site else objects.mjOBJ_XBODY).value
        self._spatial = np.zeros(6)

    def position(self, data: Any) -> Vector:
        """In the world, metres."""
        positions = data.site_xpos if self._is_site else data.xpos
        return np.array(positions[self.index])

    def orientation(self, data: Any) -> Vector:
        """In the world, a unit quaternion."""
        if not self._is_site:
            return np.array(data.xquat[self.index])
        turned = np.zeros(4)
        body = self._model.site_bodyid[self.index]
        mujoco.mju_mulQuat(turned, data.xquat[body], self._model.site_quat[self.index])
        return turned

    def angular_velocity(self, data: Any) -> Vector:
        """In the frame of the place, rad/s: a gyroscope."""
        mujoco.mj_objectVelocity(self._model, data, self.object, self.index, self._spatial, 1)
        return np.array(self._spatial[:3])

    def acceleration(self, data: Any) -> Vector:
        """In the frame of the place, m/s^2, gravity included: an accelerometer."""
        # mj_forward leaves the accelerations out unless a sensor of the model needs them.
        if not getattr(data, "flg_rnepost", False):
            mujoco.mj_rnePostConstraint(self._model, data)
        mujoco.mj_objectAcceleration(self._model, data, self.object, self.index, self._spatial, 1)
        return np.array(self._spatial[3:])


@dataclass(frozen=True)
class OwnSensor:
    """A sensor that the model declares: where its reading is, and the square of its ``noise``."""

    start: int
    end: int
    variance: float

    def read(self, data: Any) -> Vector:
        return np.array(data.sensordata[self.start : self.end])


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
