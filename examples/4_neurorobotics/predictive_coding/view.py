"""From a camera's picture and a heading to what the network takes, and back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuros.snn import GaussianTuning, PopulationVector, evenly_spaced_angles

WIDTH, HEIGHT = 20, 15
PIXELS = WIDTH * HEIGHT * 3
CODES = 180

_PREFERRED_RAD = evenly_spaced_angles(CODES)
_BUMP = GaussianTuning(_PREFERRED_RAD, math.radians(18), peak_hz=1.0, period=math.tau)
_READ = PopulationVector(_PREFERRED_RAD)


def pixels_of(image: Any) -> NDArray[np.float32]:
    """A ``sensor_msgs/msg/Image`` (``rgb8``) averaged to 20 x 15 and made independent of the light.

    Mean 0 and standard deviation 1 over the image, ``(900,)``.
    """
    pixels = np.frombuffer(image.data, dtype=np.uint8).reshape(image.height, image.width, 3)
    blocks = pixels.reshape(HEIGHT, image.height // HEIGHT, WIDTH, image.width // WIDTH, 3)
    small = blocks.mean(axis=(1, 3)).ravel()
    return ((small - small.mean()) / (small.std() + 1e-6)).astype(np.float32)


def code_of(heading_rad: float) -> NDArray[np.float32]:
    """A bump of activity around the heading, ``(180,)``: head-direction cells."""
    return _BUMP.rates_hz(heading_rad).astype(np.float32)


def heading_of(code: NDArray[np.float32]) -> float:
    """The heading, in radians, that a predicted code stands for: squared, the peak counts most."""
    return _READ.of_rates(np.maximum(code, 0.0) ** 2).angle_rad


def yaw_of(q: Any) -> float:
    """Yaw in radians of a unit quaternion that turns about the vertical alone."""
    return 2.0 * math.atan2(q.z, q.w)
