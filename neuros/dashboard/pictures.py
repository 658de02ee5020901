"""Small pictures of images (see :mod:`neuros.runtime.sampling`) as what browsers show."""

from __future__ import annotations

import base64
import struct
import zlib
from array import array
from collections.abc import Mapping
from typing import Any

_MIME_TYPES = {"jpg": "image/jpeg", "jpeg": "image/jpeg", "png": "image/png"}
_GREY, _RGB, _RGBA = 0, 2, 6


def data_url(picture: Mapping[str, Any]) -> str | None:
    """The picture as a ``data:`` URL, ``None`` if there is no way to show it."""
    encoding, data = picture["encoding"], base64.b64decode(picture["data"])
    if not picture["width"]:  # compressed: "jpeg", or "rgb8; jpeg compressed bgr8"
        kind = next((kind for kind in _MIME_TYPES if kind in encoding), None)
        return kind and f"data:{_MIME_TYPES[kind]};base64,{picture['data']}"
    colour, pixels = _as_png_pixels(encoding, data)
    png = _png(picture["width"], picture["height"], colour, pixels)
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def _as_png_pixels(encoding: str, data: bytes) -> tuple[int, bytes]:
    if encoding in ("rgb8", "8UC3"):
        return _RGB, data
    if encoding == "rgba8":
        return _RGBA, data
    if encoding in ("bgr8", "bgra8"):
        size = 3 if encoding == "bgr8" else 4
        swapped = bytearray(data)
        swapped[0::size], swapped[2::size] = data[2::size], data[0::size]
        return (_RGB if size == 3 else _RGBA), bytes(swapped)
    if encoding in ("mono16", "16UC1"):
        return _GREY, _stretched(array("H", data))
    if encoding == "32FC1":
        return _GREY, _stretched(array("f", data))
    return _GREY, data


def _stretched(values: array[Any]) -> bytes:
    """Depths in grey, from the nearest to the farthest; what is not finite is black."""
    seen = [value for value in values if value - value == 0]
    low, high = min(seen, default=0), max(seen, default=0)
    scale = 255 / (high - low) if high > low else 0.0
    return bytes(round((v - low) * scale) if v - v == 0 else 0 for v in values)


def _png(width: int, height: int, colour: int, pixels: bytes) -> bytes:
    """PNG (ISO/IEC 15948): 8 bits per channel, rows without filter."""
    row = len(pixels) // height
    lines = b"".join(b"\0" + pixels[y * row : (y + 1) * row] for y in range(height))
    header = struct.pack(">IIBBBBB", width, height, 8, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        _chunk(kind, data)
        for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(lines, 1)), (b"IEND", b""))
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
