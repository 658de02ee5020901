"""Images as JPEG: their layout survives, their pixels nearly; what JPEG cannot hold is refused."""

from __future__ import annotations

import sys
from array import array
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import CompressedImage, Image

from neuros.errors import EnvironmentFault, WrongValue
from neuros.transport.codecs import WrongBytes, message_codec
from neuros.transport.envelope import Traffic
from neuros.transport.jpeg import JpegCodec, jpeg_checker

CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}


def image(encoding: str = "rgb8", *, width: int = 64, height: int = 48, padding: int = 0) -> Image:
    """A smooth image, whose channels differ."""
    channels = CHANNELS[encoding]
    rows, columns = np.mgrid[0:height, 0:width]
    planes = [2 * columns, 3 * rows, columns + rows][:channels]
    pixels = np.stack(planes, -1).astype(np.uint8).reshape(height, -1)
    padded = np.pad(pixels, ((0, 0), (0, padding)), constant_values=255)
    made = Image(width=width, height=height, encoding=encoding, step=padded.shape[1])
    made.header.frame_id, made.header.stamp.sec = "eye", 7
    made.data = array("B", padded.tobytes())
    return made


def pixels(message: Image) -> Any:
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    return rows[:, : message.width * CHANNELS[message.encoding]].astype(int)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", CHANNELS)
def test_an_image_is_nearly_what_it_was(encoding: str, padding: int) -> None:
    sent = image(encoding, padding=padding)
    codec = JpegCodec(95, Traffic())
    received = codec.decode(codec.encode(sent))
    assert received.header == sent.header
    assert (received.width, received.height, received.encoding) == (64, 48, encoding)
    assert received.step == 64 * CHANNELS[encoding]
    assert abs(pixels(received) - pixels(sent)).max() < 16
    assert abs(pixels(received) - pixels(sent)).mean() < 3


def test_a_lower_quality_takes_fewer_bytes() -> None:
    assert len(JpegCodec(30, Traffic()).encode(image())) < len(
        JpegCodec(95, Traffic()).encode(image())
    )


def test_bytes_are_counted_before_and_after() -> None:
    traffic = Traffic()
    sent = JpegCodec(95, traffic).encode(image())
    assert traffic == Traffic(64 * 48 * 3, len(sent))


def test_it_travels_as_the_message_that_ros_tools_show() -> None:
    message = message_codec(CompressedImage).decode(JpegCodec(95, Traffic()).encode(image("rgb8")))
    assert message.format == "rgb8; jpeg compressed bgr8"
    assert message.header.frame_id == "eye"
    assert bytes(message.data[:2]) == b"\xff\xd8"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"encoding": "32FC1"}, "field 'encoding' must be one of rgb8, bgr8, mono8"),
        ({"width": 0}, "field 'width' must be 1 to 65500"),
        ({"height": 70_000}, "field 'height' must be 1 to 65500"),
        ({"step": 100}, "field 'step' must be 192 at least"),
        ({"data": array("B", bytes(100))}, "field 'data' must be of 9216 bytes"),
    ],
)
def test_what_jpeg_cannot_hold_is_refused(changes: dict[str, Any], says: str) -> None:
    wrong = image()
    assert jpeg_checker()(wrong) is wrong
    for name, value in changes.items():
        setattr(wrong, name, value)
    with pytest.raises(WrongValue, match=says):
        jpeg_checker()(wrong)


def test_what_is_no_jpeg_is_refused() -> None:
    plain = message_codec(CompressedImage)
    grey = message_codec(CompressedImage).decode(JpegCodec(95, Traffic()).encode(image("mono8")))
    for form, data in (
        ("rgb8; jpeg", b"no image"),
        ("rgb8; jpeg", bytes(grey.data)),
        ("mono8; jpeg", bytes(grey.data[:200])),
        ("16UC1; png", bytes(grey.data)),
    ):
        message = CompressedImage(format=form, data=array("B", data))
        with pytest.raises(WrongBytes):
            JpegCodec(95, Traffic()).decode(plain.encode(message))


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(EnvironmentFault, match="pip install pillow"):
        JpegCodec(95, Traffic())
