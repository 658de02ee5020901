"""How far an estimated heading is from the true one, compared at equal stamps.

Headings are radians, counter-clockwise positive, wrapped to (-pi, pi]; stamps are nanoseconds of
simulated time. Numpy only: no ROS, no NeuROS.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_TURN_FOR_GAIN_RAD = np.radians(90.0)
"""A gain is a slope against the true heading: with less turn than this it means nothing."""


@dataclass(frozen=True)
class Comparison:
    """Estimate and truth at the stamps of the estimates, unwrapped: angles go on past 180 degrees.

    Attributes:
        time_s: stamps of the estimates that lie within the stamps of the truth, ``(n,)``.
        truth_rad: true heading at these times, ``(n,)``.
        error_rad: estimate minus truth, ``(n,)``.
    """

    time_s: Array
    truth_rad: Array
    error_rad: Array


@dataclass(frozen=True)
class HeadingError:
    """The error of a whole run. Fields that the run is too short to tell are ``None``.

    Attributes:
        samples: estimates that were compared.
        rms_deg, max_deg: of the error, in degrees.
        gain: turn of the estimate per turn of the robot.
        drift_deg_s: slope of the error over time, in degrees per second.
    """

    samples: int
    rms_deg: float | None = None
    max_deg: float | None = None
    gain: float | None = None
    drift_deg_s: float | None = None

    def __str__(self) -> str:
        return (
            f"RMS {_shown(self.rms_deg, '.2f', ' deg')}, "
            f"maximum {_shown(self.max_deg, '.2f', ' deg')}, "
            f"gain {_shown(self.gain, '.4f')}, "
            f"drift {_shown(self.drift_deg_s, '+.3f', ' deg/s')}, "
            f"aligned by stamp over {self.samples} estimates"
        )


def compare(estimates: Mapping[int, float], truths: Mapping[int, float]) -> Comparison:
    """Align two series, each ``{stamp in ns: heading in rad}``, at the stamps of the estimates.

    Where a true heading was lost on the way, it is interpolated between its neighbours.
    """
    stamps = np.array(sorted(truths), dtype=np.int64)
    wanted = np.array(sorted(estimates), dtype=np.int64)
    if stamps.size:
        wanted = wanted[(wanted >= stamps[0]) & (wanted <= stamps[-1])]
    if stamps.size == 0 or wanted.size == 0:
        nothing = np.empty(0)
        return Comparison(nothing, nothing, nothing)
    true_rad = _unwrap_along(stamps * 1e-9, np.array([truths[int(stamp)] for stamp in stamps]))
    truth_rad = np.interp(wanted, stamps, true_rad)
    estimate_rad = np.array([estimates[int(stamp)] for stamp in wanted])
    # The error changes slowly even where the heading does not: it is what can be unwrapped safely.
    error_rad = np.unwrap(_wrap(estimate_rad - truth_rad))
    return Comparison(wanted * 1e-9, truth_rad, error_rad)


def heading_error(comparison: Comparison) -> HeadingError:
    """Summarise an aligned comparison."""
    error_deg = np.degrees(comparison.error_rad)
    if error_deg.size == 0:
        return HeadingError(0)
    truth_rad = comparison.truth_rad
    enough = error_deg.size >= 2
    turned = float(np.ptp(truth_rad))
    return HeadingError(
        samples=int(error_deg.size),
        rms_deg=float(np.sqrt(np.mean(error_deg**2))),
        max_deg=float(np.max(np.abs(error_deg))),
        gain=(
            1.0 + _slope(truth_rad, comparison.error_rad)
            if enough and turned >= MIN_TURN_FOR_GAIN_RAD
            else None
        ),
        drift_deg_s=_slope(comparison.time_s, error_deg) if enough else None,
    )


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Yaw of a unit quaternion: the heading of a robot that stands upright."""
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def _unwrap_along(time_s: Array, wrapped_rad: Array) -> Array:
    """Unwrap on the assumption that the last known rate goes on through a gap in the series."""
    # Floats of Python: for numbers one at a time, those of NumPy take ten times as long.
    last_s, last_rad, rate = float(time_s[0]), float(wrapped_rad[0]), 0.0
    unwrapped = [last_rad]
    for now_s, now_rad in zip(time_s[1:].tolist(), wrapped_rad[1:].tolist(), strict=True):
        expected = last_rad + rate * (now_s - last_s)
        unwrapped.append(expected + math.remainder(now_rad - expected, math.tau))
        rate = (unwrapped[-1] - last_rad) / (now_s - last_s)
        last_s, last_rad = now_s, unwrapped[-1]
    return np.array(unwrapped)


def _wrap(angle_rad: Array) -> Array:
    return np.angle(np.exp(1j * angle_rad))


def _slope(x: Array, y: Array) -> float:
    """Least-squares slope of y against x."""
    dx = x - x.mean()
    return float(np.dot(dx, y - y.mean()) / np.dot(dx, dx))


def _shown(value: float | None, form: str, unit: str = "") -> str:
    return "unknown" if value is None else f"{value:{form}}{unit}"
