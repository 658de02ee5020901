"""Poses: position and rotation of frames, and the ``<pose>`` of an element."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
import numpy.typing as npt

from neuros.simulators.convert.elements import Element

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pose:
    """Position and rotation of one frame, seen from another.

    Attributes:
        position: of its origin, shape (3,), metres.
        rotation: its axes as columns, shape (3, 3).
    """

    position: Vector = field(default_factory=lambda: np.zeros(3))
    rotation: Vector = field(default_factory=lambda: np.eye(3))

    def __matmul__(self, other: Pose) -> Pose:
        """Chain two poses: ``other`` is seen from this one's frame."""
        return Pose(self.rotation @ other.position + self.position, self.rotation @ other.rotation)

    def inverse(self) -> Pose:
        """The pose in the opposite direction: of the other frame, seen from this one."""
        return Pose(-self.rotation.T @ self.position, self.rotation.T)

    @property
    def quaternion(self) -> Vector:
        """The rotation as w, x, y, z, shape (4,)."""
        result = np.zeros(4)
        mujoco.mju_mat2Quat(result, np.ascontiguousarray(self.rotation).ravel())
        return result


def from_rpy(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> Pose:
    """A pose in metres and radians; turned about the fixed axes x, y and z, in this order."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return Pose(np.array([x, y, z], float), about_z @ about_y @ about_x)


def from_quaternion(position: Sequence[float], wxyz: Sequence[float] | Vector) -> Pose:
    """A pose in metres; the quaternion (w, x, y, z) need not have the length 1."""
    matrix, quaternion = np.zeros(9), np.array(wxyz, float)
    mujoco.mju_normalize4(quaternion)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return Pose(np.array(position, float), matrix.reshape(3, 3))


def read_pose(owner: Element) -> Pose:
    """The pose in the ``<pose>`` of ``owner``, relative to what that names."""
    element = owner.child("pose")
    if element is None or not element.text:
        return Pose()
    if element.attributes.get("rotation_format") == "quat_xyzw":
        x, y, z, qx, qy, qz, qw = element.numbers((0, 0, 0, 0, 0, 0, 1))
        if not math.hypot(qx, qy, qz, qw):
            element.problem("the quaternion is zero")
            return Pose()
        return from_quaternion((x, y, z), (qw, qx, qy, qz))
    x, y, z, *angles = element.numbers((0,) * 6)
    if element.has("degrees"):
        angles = [math.radians(angle) for angle in angles]
    return from_rpy(x, y, z, *angles)
