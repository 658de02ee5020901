"""Values in XML: numbers, vectors, truth values and poses (x, y, z, roll, pitch, yaw)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
import numpy.typing as npt

from neuros.simulators.convert.elements import Element
from neuros.simulators.convert.report import Report

Vector = npt.NDArray[np.float64]


def numbers(
    element: Element, count: int, report: Report, default: Sequence[float]
) -> tuple[float, ...]:
    """``count`` finite numbers; after a problem ``default``."""
    values: list[float] = []
    for word in element.text.split():
        try:
            values.append(float(word))
        except ValueError:
            report.problem(element, f"'{word}' is not a number")
            return tuple(default)
    if len(values) != count:
        what = "a number" if count == 1 else f"{count} numbers"
        report.problem(element, f"{what} must stand here, not {len(values)}")
        return tuple(default)
    if any(math.isnan(value) for value in values):
        report.problem(element, "every number must be one, not nan")
        return tuple(default)
    return tuple(values)


def vector(
    owner: Element, tag: str, report: Report, default: tuple[float, ...]
) -> tuple[float, ...]:
    """The numbers in the child ``tag``, as many as ``default`` has, which holds without it."""
    element = owner.child(tag)
    if element is None or not element.text:
        return default
    values = numbers(element, len(default), report, default)
    if all(map(math.isfinite, values)):
        return values
    report.problem(element, "every number must be finite")
    return default


def number(
    owner: Element, tag: str, report: Report, default: float, *, positive: bool = False
) -> float:
    """The number in the child ``tag``; it may be infinite, unless it must be ``positive``."""
    element = owner.child(tag)
    if element is None or not element.text:
        return default
    (value,) = numbers(element, 1, report, (default,))
    if positive and not 0 < value < math.inf:
        report.problem(element, f"must be a positive number, not {value:g}")
        return default
    return value


def is_true(owner: Element, tag: str, report: Report, *, default: bool) -> bool:
    """The truth value in the child ``tag``."""
    element = owner.child(tag)
    if element is None:
        return default
    word = element.text.lower()
    if word not in ("true", "1", "false", "0"):
        report.problem(element, f"'{element.text}' is neither true nor false")
        return default
    return word in ("true", "1")


def text_of(owner: Element, tag: str) -> str:
    """The text of the child ``tag``; empty without it."""
    element = owner.child(tag)
    return "" if element is None else element.text


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


def turning_z_to(direction: Vector) -> Vector:
    """A quaternion (w, x, y, z) that turns the z axis to ``direction``, which need not be unit."""
    result = np.zeros(4)
    mujoco.mju_quatZ2Vec(result, direction / np.linalg.norm(direction))
    return result


def read_pose(owner: Element, report: Report) -> Pose:
    """The pose in the ``<pose>`` of ``owner``, relative to what that names."""
    element = owner.child("pose")
    if element is None or not element.text:
        return Pose()
    if element.attributes.get("rotation_format", "euler_rpy") == "quat_xyzw":
        x, y, z, qx, qy, qz, qw = numbers(element, 7, report, (0, 0, 0, 0, 0, 0, 1))
        if not math.hypot(qx, qy, qz, qw):
            report.problem(element, "the quaternion is zero")
            return Pose()
        return from_quaternion((x, y, z), (qw, qx, qy, qz))
    x, y, z, *angles = numbers(element, 6, report, (0,) * 6)
    if element.attributes.get("degrees", "false") in ("true", "1"):
        angles = [math.radians(angle) for angle in angles]
    return from_rpy(x, y, z, *angles)
