"""Buffers are found in messages, left out and put back."""

from __future__ import annotations

import copy
from array import array
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Polygon
from nav_msgs.msg import OccupancyGrid
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image, Imu, JointState, LaserScan, PointCloud2
from std_msgs.msg import ByteMultiArray, Float64MultiArray, String
from stereo_msgs.msg import DisparityImage

from neuros.transport.large_packets import SegmentReader, SegmentWriter, message_buffers
from neuros.transport.messages import message_class

message_class("sensor_msgs/msg/Image")  # loads what ROS needs for its first message


@pytest.mark.parametrize(
    ("kind", "fields", "typecodes"),
    [
        (Image, ("data",), ("B",)),
        (PointCloud2, ("data",), ("B",)),
        (OccupancyGrid, ("data",), ("b",)),
        (Float64MultiArray, ("data",), ("d",)),
        (LaserScan, ("ranges", "intensities"), ("f", "f")),
        (JointState, ("position", "velocity", "effort"), ("d", "d", "d")),
        (DisparityImage, ("image.data",), ("B",)),
    ],
)
def test_sequences_of_numbers_are_found(
    kind: type, fields: tuple[str, ...], typecodes: tuple[str, ...]
) -> None:
    buffers = message_buffers(kind)
    assert buffers is not None
    assert (buffers.fields, buffers.typecodes) == (fields, typecodes)


@pytest.mark.parametrize("kind", [String, Imu, Polygon, ByteMultiArray])
def test_other_messages_have_none(kind: type) -> None:
    assert message_buffers(kind) is None


def _image() -> Image:
    image = Image(height=2, width=3, step=9, encoding="bgr8")
    image.header.frame_id = "left"
    image.data = array("B", range(18))
    return image


def _disparity() -> DisparityImage:
    message = DisparityImage(f=1.5)
    message.image = _image()
    return message


def _scan() -> LaserScan:
    scan = LaserScan(angle_max=1.5)
    scan.ranges, scan.intensities = array("f", [0.5, 2.0]), array("f", [7.0])
    return scan


def travelled(packet: Any, kind: type) -> Any:
    """The message as ROS carries it; its bytes may differ, for ROS leaves padding as it was."""
    return deserialize_message(serialize_message(packet), kind)


MESSAGES = [_image(), _disparity(), _scan()]


@pytest.mark.parametrize("packet", MESSAGES, ids=lambda packet: type(packet).__name__)
def test_leaving_buffers_out_leaves_the_message_as_it_is(packet: Any) -> None:
    buffers = message_buffers(type(packet))
    assert buffers is not None
    before = copy.deepcopy(packet)
    without = buffers.leave_out(packet)
    assert packet == before
    found = buffers.of(without)
    assert found is not None
    assert not any(found)
    assert len(serialize_message(without)) < len(serialize_message(packet))


def test_what_is_not_the_array_of_ros_is_not_taken() -> None:
    buffers = message_buffers(Image)
    disparity = message_buffers(DisparityImage)
    assert buffers is not None
    assert disparity is not None
    odd = Image()
    odd._data = bytes(10)
    assert buffers.of(odd) is None
    odd._data = array("H", [1, 2])
    assert buffers.of(odd) is None
    assert buffers.of(String()) is None
    odd = DisparityImage()
    odd.image = None
    assert disparity.of(odd) is None


@pytest.mark.parametrize("packet", MESSAGES, ids=lambda packet: type(packet).__name__)
def test_a_message_whose_buffers_went_through_shared_memory_is_the_message(
    packet: Any, tmp_path: Path
) -> None:
    buffers = message_buffers(type(packet))
    assert buffers is not None
    place = SegmentWriter("owner", 1, tmp_path).write(buffers.of(packet) or [])
    twin = travelled(buffers.leave_out(packet), type(packet))
    buffers.put_back(twin, SegmentReader(tmp_path).read(place, buffers.typecodes) or [])
    assert twin == packet
    assert buffers.of(twin) == buffers.of(packet)
