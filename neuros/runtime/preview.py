"""Small pictures of images, without any library: every k-th pixel of every k-th row."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

WIDTH, HEIGHT = 320, 240
"""A picture is no larger than this."""

_MOST_COMPRESSED_BYTES = 400_000

# Bytes per pixel, by the names of sensor_msgs/image_encodings.
PIXEL_BYTES = {
    "rgb8": 3,
    "bgr8": 3,
    "rgba8": 4,
    "bgra8": 4,
    "mono8": 1,
    "8UC1": 1,
    "8UC3": 3,
    "mono16": 2,
    "16UC1": 2,
    "32FC1": 4,
}


@dataclass(frozen=True)
class Preview:
    """A picture in the making: what was copied while the packet passed.

    Attributes:
        rows: of the pixels that are kept and those between them.
        stride: every so many pixels one is kept.
        pixel_bytes: 0 for what is compressed already, which is then the only row.
    """

    encoding: str
    width: int
    height: int
    rows: tuple[bytes, ...]
    stride: int
    pixel_bytes: int

    def encode(self) -> dict[str, Any]:
        """The picture, ready for JSON: ``width``, ``height``, ``encoding``, ``data`` (base64)."""
        size = self.pixel_bytes
        if not size:
            data = self.rows[0]
            width, height = self.width, self.height
        else:
            width, height = -(-self.width // self.stride), len(self.rows)
            picture = bytearray(width * height * size)
            for y, row in enumerate(self.rows):
                begin = y * width * size
                for byte in range(size):
                    picture[begin + byte : begin + width * size : size] = row[
                        byte :: size * self.stride
                    ]
            data = bytes(picture)
        return {
            "width": width,
            "height": height,
            "of": [self.width, self.height],
            "encoding": self.encoding,
            "data": base64.b64encode(data).decode(),
        }


def preview(packet: Any) -> Preview:
    """Copy what a picture needs from a ``sensor_msgs`` Image or CompressedImage.

    Raises:
        ValueError: if it is none that can be shown.
    """
    if hasattr(packet, "format"):
        data = bytes(packet.data)
        if len(data) > _MOST_COMPRESSED_BYTES:
            raise ValueError(f"a compressed image of {len(data)} bytes is too large to be shown")
        return Preview(packet.format, 0, 0, (data,), 1, 0)
    size = PIXEL_BYTES.get(packet.encoding)
    if size is None:
        raise ValueError(f"images with encoding '{packet.encoding}' are not shown")
    width, height, step = packet.width, packet.height, packet.step or packet.width * size
    pixels = memoryview(packet.data).cast("B")
    if not (width and height) or step < width * size or len(pixels) < step * height:
        raise ValueError(f"{len(pixels)} bytes are no image of {width} x {height}, {step} per row")
    stride = max(1, -(-width // WIDTH), -(-height // HEIGHT))
    rows = tuple(
        bytes(pixels[y * step : y * step + width * size]) for y in range(0, height, stride)
    )
    return Preview(packet.encoding, width, height, rows, stride, size)
