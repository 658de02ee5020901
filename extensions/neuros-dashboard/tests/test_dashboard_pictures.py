"""From an image message to a small picture that a browser can show."""

from __future__ import annotations

import base64
import io
import struct
from array import array
from typing import Any

import pytest
from neuros_dashboard.pages import data_url
from PIL import Image as Decoder
from sensor_msgs.msg import CompressedImage, Image

from neuros.node.sampling import preview


def message(width: int, height: int, encoding: str, data: bytes, step: int = 0) -> Image:
    image = Image(width=width, height=height, encoding=encoding)
    image.step = step or len(data) // height
    image.data = array("B", data)
    return image


def shown(packet: Any) -> Decoder.Image:
    """What a decoder sees."""
    url = data_url(preview(packet).encode())
    assert url is not None
    kind, _, data = url.partition(";base64,")
    assert kind.startswith("data:image/")
    return Decoder.open(io.BytesIO(base64.b64decode(data)))


@pytest.mark.parametrize(
    ("encoding", "pixel", "seen"),
    [
        ("rgb8", b"\x01\x02\x03", (1, 2, 3)),
        ("bgr8", b"\x01\x02\x03", (3, 2, 1)),
        ("rgba8", b"\x01\x02\x03\x04", (1, 2, 3, 4)),
        ("bgra8", b"\x01\x02\x03\x04", (3, 2, 1, 4)),
        ("mono8", b"\x07", 7),
    ],
)
def test_pixels_keep_their_colours(encoding: str, pixel: bytes, seen: Any) -> None:
    picture = shown(message(4, 3, encoding, pixel * 12))
    assert picture.size == (4, 3)
    assert picture.getpixel((3, 2)) == seen


def test_a_large_image_is_thinned_out_and_keeps_its_places() -> None:
    width, height = 641, 480
    rows = b"".join(
        bytes(v for x in range(width) for v in (x % 256, y % 256, 0)) for y in range(height)
    )
    picture = shown(message(width, height, "rgb8", rows))
    assert picture.size == (214, 160)  # every third pixel: 641 are more than 2 x 320
    assert picture.getpixel((0, 0)) == (0, 0, 0)
    assert picture.getpixel((10, 20)) == (30, 60, 0)
    assert picture.getpixel((213, 159)) == (639 % 256, 477 % 256, 0)


def test_what_pads_the_rows_is_not_shown() -> None:
    picture = shown(message(2, 2, "mono8", b"\x01\x02\xff\xff\x03\x04\xff\xff", step=4))
    assert [picture.getpixel((x, y)) for y in range(2) for x in range(2)] == [1, 2, 3, 4]


@pytest.mark.parametrize(("encoding", "kind"), [("16UC1", "H"), ("32FC1", "f")])
def test_depths_are_stretched_from_black_to_white(encoding: str, kind: str) -> None:
    data = struct.pack(f"<4{kind}", 100, 200, 150, 100)
    picture = shown(message(2, 2, encoding, data))
    assert [picture.getpixel((x, y)) for y in range(2) for x in range(2)] == [0, 255, 127, 0]


def test_a_depth_that_is_no_number_is_black() -> None:
    data = struct.pack("<4f", 1.0, float("nan"), float("inf"), 2.0)
    picture = shown(message(2, 2, "32FC1", data))
    assert [picture.getpixel((x, y)) for y in range(2) for x in range(2)] == [0, 0, 0, 255]


def test_a_compressed_image_goes_through_as_it_is() -> None:
    file = io.BytesIO()
    Decoder.new("RGB", (8, 6), (200, 10, 10)).save(file, "jpeg")
    packet = CompressedImage(format="rgb8; jpeg compressed bgr8")
    packet.data = array("B", file.getvalue())
    assert shown(packet).size == (8, 6)


@pytest.mark.parametrize(
    ("packet", "why"),
    [
        (message(2, 2, "bayer_rggb8", bytes(4)), "encoding 'bayer_rggb8' are not shown"),
        (message(2, 2, "rgb8", bytes(6)), "6 bytes are not an image of 2 x 2"),
        (Image(encoding="rgb8"), "not an image of 0 x 0"),
    ],
)
def test_what_cannot_be_shown_is_told(packet: Image, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        preview(packet)
