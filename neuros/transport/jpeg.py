"""Images as JPEG, on connections that ask for it: ``"transport": {"compression": "jpeg"}``.

A ``sensor_msgs/msg/Image`` travels as the ``sensor_msgs/msg/CompressedImage`` that the ROS package
``compressed_image_transport`` makes of it, so ROS tools show the topic. Its receiver gets the
decoded image, which is not quite the one that was sent; it is the same one on every back end, so
also packets that do not leave the process are encoded and decoded.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import cache
from io import BytesIO
from typing import Any

from sensor_msgs.msg import CompressedImage, Image

from neuros.errors import EnvironmentFault, WrongValue
from neuros.transport.codecs import WrongBytes, message_codec
from neuros.transport.envelope import Traffic
from neuros.transport.values import checker

# By encoding (sensor_msgs/image_encodings.hpp): Pillow's mode of the image, and of its rows.
_MODES = {"rgb8": ("RGB", "RGB"), "bgr8": ("RGB", "BGR"), "mono8": ("L", "L")}
_LONGEST_SIDE = 65_500  # pixels; libjpeg's JPEG_MAX_DIMENSION


KIND: type = CompressedImage
"""The message class on the topics of these connections."""


class JpegCodec:
    """Encodes and decodes the images of a connection (:class:`neuros.transport.codecs.Codec`).

    Args:
        quality: of libjpeg, 1 to 100.
        traffic: counts what is encoded.

    Raises:
        EnvironmentFault: if Pillow is not installed.
    """

    def __init__(self, quality: int, traffic: Traffic) -> None:
        try:
            import PIL.Image
        except ImportError as error:
            raise EnvironmentFault(
                f'"compression": "jpeg" needs Pillow ({error}): pip install pillow'
            ) from None
        self._pillow = PIL.Image
        self._quality = quality
        self._traffic = traffic
        self._plain = message_codec(CompressedImage)

    def encode(self, packet: Any) -> bytes:
        """The serialised ``CompressedImage`` of an image that has been checked."""
        mode, rows = _MODES[packet.encoding]
        size = (packet.width, packet.height)
        image = self._pillow.frombuffer(mode, size, packet.data, "raw", rows, packet.step, 1)
        made = BytesIO()
        image.save(made, "JPEG", quality=self._quality)
        colours = packet.encoding if mode == "L" else "bgr8"  # as compressed_image_transport says
        message = CompressedImage(
            header=packet.header,
            format=f"{packet.encoding}; jpeg compressed {colours}",
            data=array("B", made.getvalue()),
        )
        encoded = self._plain.encode(message)
        self._traffic.bytes += len(packet.data)
        self._traffic.compressed_bytes += len(encoded)
        return encoded

    def decode(self, data: bytes) -> Any:
        """The decoded ``Image``, without padding in its rows.

        Raises:
            WrongBytes: if it cannot be decoded.
        """
        message = self._plain.decode(data)
        encoding = message.format.partition(";")[0]
        try:
            mode, rows = _MODES[encoding]
            with self._pillow.open(BytesIO(message.data), formats=["JPEG"]) as image:
                if image.mode != mode:
                    raise ValueError(f"its colours are {image.mode}, not {mode}")
                pixels = image.tobytes("raw", rows)
                width, height = image.size
        except (KeyError, OSError, ValueError, self._pillow.DecompressionBombError) as error:
            raise WrongBytes(CompressedImage, data, error) from error
        return Image(
            header=message.header,
            height=height,
            width=width,
            encoding=encoding,
            step=len(pixels) // height,
            data=array("B", pixels),
        )


@cache
def jpeg_checker() -> Callable[[Any], Any]:
    """As :func:`neuros.transport.values.checker`, for images that can be encoded."""
    check = checker(Image)

    def check_image(packet: Any) -> Any:
        packet = check(packet)
        if packet.encoding not in _MODES:
            allowed = f"one of {', '.join(_MODES)} on a connection with JPEG"
            raise WrongValue("encoding", repr(packet.encoding), allowed)
        for name in ("width", "height"):
            if not 0 < getattr(packet, name) <= _LONGEST_SIDE:
                allowed = f"1 to {_LONGEST_SIDE} on a connection with JPEG"
                raise WrongValue(name, str(getattr(packet, name)), allowed)
        shortest = packet.width * (1 if packet.encoding == "mono8" else 3)
        if packet.step < shortest:
            raise WrongValue("step", str(packet.step), f"{shortest} at least, the bytes of a row")
        if len(packet.data) < packet.step * packet.height:
            raise WrongValue(
                "data",
                f"of {len(packet.data)} bytes",
                f"of {packet.step * packet.height} bytes, step times height",
            )
        return packet

    return check_image
