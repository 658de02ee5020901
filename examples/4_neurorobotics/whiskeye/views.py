"""From the pictures of both eyes and a heading to what the network takes, and back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neuros.snn import GaussianTuning, PopulationVector, evenly_spaced_angles

Floats = NDArray[np.float32]

WIDTH, HEIGHT = 16, 12
PIXELS = 2 * WIDTH * HEIGHT * 3
CODES = 180

_PREFERRED_RAD = evenly_spaced_angles(CODES)
_BUMP = GaussianTuning(_PREFERRED_RAD, math.radians(12), peak_hz=1.0, period=math.tau)
_READ = PopulationVector(_PREFERRED_RAD)


def view_of(left: Any, right: Any) -> Floats:
    """Two ``sensor_msgs/msg/Image`` (``rgb8``), averaged to 16 x 12 each, whatever the light.

    Mean 0 and standard deviation 1 over both, ``(1152,)``.
    """
    return standardised(averaged(left, right))


def standardised(small: NDArray[np.floating]) -> Floats:
    """Mean colours ``(..., 1152)`` with mean 0 and standard deviation 1 each."""
    mean, deviation = (f(small, axis=-1, keepdims=True) for f in (np.mean, np.std))
    return ((small - mean) / (deviation + 1e-6)).astype(np.float32)


def picture_of(view: Floats, left: Any, right: Any) -> NDArray[np.uint8]:
    """A view ``(1152,)`` as a picture, both eyes side by side: as large and light as these images.

    Of images of 80 x 60 pixels it is ``(60, 160, 3)``.
    """
    small = averaged(left, right)
    pixels = np.clip(small.mean() + small.std() * view, 0, 255).astype(np.uint8)
    eyes = np.hstack(list(pixels.reshape(2, HEIGHT, WIDTH, 3)))
    return eyes.repeat(left.height // HEIGHT, axis=0).repeat(left.width // WIDTH, axis=1)


def code_of(heading_rad: float) -> Floats:
    """A bump of activity around the heading, ``(180,)``: head-direction cells."""
    return _BUMP.rates_hz(heading_rad).astype(np.float32)


def heading_of(code: Floats) -> float:
    """The heading, in radians, that a predicted code stands for: with a power of 4, its peak."""
    return _READ.of_rates(np.maximum(code, 0.0) ** 4).angle_rad


def averaged(*images: Any) -> NDArray[np.float64]:
    """Mean colours of blocks of pixels, 16 x 12 of each image, one after the other ``(1152,)``."""
    small = []
    for image in images:
        pixels = np.frombuffer(image.data, dtype=np.uint8)
        blocks = (HEIGHT, image.height // HEIGHT, WIDTH, image.width // WIDTH, 3)
        small.append(pixels.reshape(blocks).mean(axis=(1, 3)).ravel())
    return np.concatenate(small)
