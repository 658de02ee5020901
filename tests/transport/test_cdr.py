"""Messages become bytes that ROS understands, and are read as ROS reads them."""

from __future__ import annotations

import contextlib
import struct
import tracemalloc
from array import array
from typing import Any

import pytest
from geometry_msgs.msg import PoseArray
from hypothesis import HealthCheck, given, settings
from message_values import parts, right_messages
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Int32, String

from neuros.transport.codecs import CdrCodec, MessageCodec, WrongBytes, message_codec
from neuros.transport.messages import message_class

TYPES = (
    "builtin_interfaces/Time", "diagnostic_msgs/DiagnosticArray", "geometry_msgs/PoseArray",
    "geometry_msgs/TwistStamped", "sensor_msgs/Image", "sensor_msgs/Imu", "sensor_msgs/JointState",
    "sensor_msgs/LaserScan", "sensor_msgs/PointCloud2", "shape_msgs/SolidPrimitive",
    "std_msgs/Bool", "std_msgs/ByteMultiArray", "std_msgs/Empty", "std_msgs/Float32",
    "std_msgs/Int8", "std_msgs/String", "std_msgs/UInt64",
)  # fmt: skip
KINDS = [message_class(name.replace("/", "/msg/")) for name in (*TYPES, "std_msgs/Int32")]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_what_is_written_and_read_is_what_ros_writes_and_reads(
    kind: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    codec = message_codec(kind)
    assert isinstance(codec, CdrCodec)
    monkeypatch.delattr(MessageCodec, "encode")  # rclpy helps out nowhere
    monkeypatch.delattr(MessageCodec, "decode")
    encode, decode = codec.encode, codec.decode

    @settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
    @given(right_messages(kind))
    def check(messages: tuple[Any, Any]) -> None:
        _, message = messages
        data, by_ros = encode(message), serialize_message(message)
        # Not equal: rclpy fills neither the gaps between numbers nor all that it reserves.
        assert len(data) <= len(by_ros)
        for each in (data, by_ros):
            assert parts(decode(each)) == parts(deserialize_message(each, kind))
            assert encode(decode(each)) == data

    check()


def test_senders_of_the_other_byte_order_are_understood() -> None:
    data = b"\0\0\0\0" + struct.pack(">i", 7)
    assert message_codec(Int32).decode(data) == Int32(data=7)


@pytest.mark.parametrize("size", [0, 3, 4, 7, 11, 20])
def test_bytes_that_break_off_are_no_message(size: int) -> None:
    data = serialize_message(Image(data=array("B", range(100))))[:size]
    with pytest.raises(Exception, match="deserialize"):
        deserialize_message(data, Image)
    with pytest.raises(WrongBytes, match=rf"^{size} bytes are not a sensor_msgs/Image: "):
        message_codec(Image).decode(data)


def test_text_that_is_no_utf_8_is_read_as_ros_reads_it() -> None:
    data = serialize_message(String(data="abcd")).replace(b"bc", b"\xff\xe4")
    assert message_codec(String).decode(data) == deserialize_message(data, String)


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        (String, b"abc\0def\0"),  # as rclpy, up to the first NUL
        (String, b"abc"),
        (String, b""),
    ],
)
def test_text_of_other_writers_is_read_as_ros_reads_it(kind: type, data: bytes) -> None:
    whole = b"\0\1\0\0" + struct.pack("<I", len(data)) + data
    assert message_codec(kind).decode(whole) == deserialize_message(whole, kind)


@pytest.mark.parametrize("kind", [PoseArray, JointState, String, Image])
def test_a_length_takes_no_memory_that_the_bytes_do_not_have(kind: type) -> None:
    whole = bytearray(serialize_message(kind()))
    for at in range(4, len(whole) - 3, 4):
        data = bytes(whole[:at]) + b"\xff\xff\xff\x7f" + bytes(whole[at + 4 :])
        tracemalloc.start()
        with contextlib.suppress(WrongBytes):
            message_codec(kind).decode(data)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert most < 1 << 20
