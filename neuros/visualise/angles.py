"""Angles as they are drawn: wrapped, and with a gap where they jump by a whole turn."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def yaw_of(orientation: Any) -> float:
    """Rotation about the vertical in radians, (-pi, pi], of a unit quaternion.

    ``orientation``: anything with ``x``, ``y``, ``z``, ``w``, such as
    ``geometry_msgs/msg/Quaternion``.
    """
    q = orientation
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def wrapped(angle_rad: float) -> float:
    """The same direction in (-pi, pi]."""
    remainder = math.remainder(angle_rad, math.tau)
    return math.pi if remainder == -math.pi else remainder


def broken_at_wraps(time_s: Array, angle_rad: Array) -> tuple[Array, Array]:
    """Both series with a NaN where a line from one angle to the next would cross the figure."""
    jumps = np.flatnonzero(np.abs(np.diff(angle_rad)) > math.pi) + 1
    return np.insert(time_s, jumps, np.nan), np.insert(angle_rad, jumps, np.nan)


def population_vector(activity: Array) -> float | None:
    """The direction, in radians, that a ring of neurons stands for; ``None`` if it is silent.

    Neuron ``i`` of ``n`` prefers ``2 pi (i + 1/2) / n``; the direction is that of the sum of these
    unit vectors, weighted by activity (Georgopoulos, Schwartz & Kettner, Science 233, 1416, 1986).
    """
    phases = 2.0 * np.pi * (np.arange(activity.size) + 0.5) / max(activity.size, 1)
    total = complex(np.sum(activity * np.exp(1j * phases)))
    return None if abs(total) < 1e-12 else math.atan2(total.imag, total.real)
