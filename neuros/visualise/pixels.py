"""The pixels of an image that a figure shows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

_LARGEST_SIDE = 320
_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}


def small_pixels(image: Any) -> Any:
    """Every n-th pixel of a ``sensor_msgs/msg/Image`` or array; red comes first.

    Raises:
        ValueError: for an encoding or shape that cannot be drawn.
    """
    pixels = _pixels(image)
    step = max(1, math.ceil(max(pixels.shape[:2]) / _LARGEST_SIDE))
    return np.ascontiguousarray(pixels[::step, ::step])


def _pixels(image: Any) -> Any:
    encoding = getattr(image, "encoding", None)
    if encoding is None:
        pixels = np.asarray(image)
        if pixels.size and (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)):
            return pixels
        raise ValueError(
            f"an image has shape (height, width) or (height, width, 3): {pixels.shape}"
        )
    if encoding not in _CHANNELS:
        raise ValueError(f"images with encoding {encoding} cannot be drawn: rgb8, bgr8, mono8 can")
    channels, height, width = _CHANNELS[encoding], image.height, image.width
    data = np.frombuffer(image.data, np.uint8)
    step = image.step or width * channels
    if not (width and height) or step < width * channels or len(data) < step * height:
        raise ValueError(f"{len(data)} bytes are no image of {width} x {height}, {step} per row")
    rows = data[: step * height].reshape(height, step)
    if encoding == "mono8":
        return rows[:, :width]
    pixels = rows[:, : channels * width].reshape(height, width, channels)
    return pixels if encoding == "rgb8" else pixels[..., ::-1]
