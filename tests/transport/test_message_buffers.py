"""Buffers are found in messages, taken out and put back, and a lazy message is like any other."""

from __future__ import annotations

import copy
import pickle
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

from neuros.transport.message_buffers import SegmentReader, SegmentWriter, message_buffers
from neuros.transport.messages import copy_packet, message_class
from neuros.transport.values import checker

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


def lazy(packet: Any, folder: Path) -> Any:
    """The message as a receiver gets it: its buffers still in shared memory."""
    buffers = message_buffers(type(packet))
    assert buffers is not None
    found = buffers.of(packet)
    assert found is not None
    place = SegmentWriter("owner", 1, folder).write(found)
    twin = deserialize_message(serialize_message(buffers.leave_out(packet)), type(packet))
    stored = SegmentReader(folder).find(place, buffers.typecodes)
    assert stored is not None
    buffers.put_back(twin, stored)
    return twin


@pytest.mark.parametrize("packet", MESSAGES, ids=lambda packet: type(packet).__name__)
class TestLazyMessages:
    """Whatever is done to a lazy message first, it is the message that was sent."""

    def test_it_is_of_its_class(self, packet: Any, tmp_path: Path) -> None:
        message = lazy(packet, tmp_path)
        assert isinstance(message, type(packet))
        assert type(message).__name__ == type(packet).__name__
        assert type(message).__module__ == type(packet).__module__
        assert message.__slots__ == packet.__slots__

    def test_it_equals(self, packet: Any, tmp_path: Path) -> None:
        assert lazy(packet, tmp_path) == packet
        assert packet == lazy(packet, tmp_path)
        assert lazy(packet, tmp_path) != type(packet)()

    def test_it_reads_the_same(self, packet: Any, tmp_path: Path) -> None:
        assert repr(lazy(packet, tmp_path)) == repr(packet)

    def test_it_is_serialised(self, packet: Any, tmp_path: Path) -> None:
        assert travelled(lazy(packet, tmp_path), type(packet)) == packet

    def test_it_is_copied(self, packet: Any, tmp_path: Path) -> None:
        for made in (
            copy.copy,
            copy.deepcopy,
            lambda m: copy_packet(checker(type(packet))(m)),
            lambda m: pickle.loads(pickle.dumps(m)),
        ):
            twin = made(lazy(packet, tmp_path))
            assert type(twin) is type(packet)
            assert twin == packet

    def test_its_buffers_can_be_sent_on(self, packet: Any, tmp_path: Path) -> None:
        buffers = message_buffers(type(packet))
        assert buffers is not None
        assert buffers.of(lazy(packet, tmp_path)) == buffers.of(packet)
        serialize_message(buffers.leave_out(lazy(packet, tmp_path)))


def test_fields_of_a_late_message_may_be_set(tmp_path: Path) -> None:
    message = lazy(_scan(), tmp_path)
    message.ranges = array("f", [9.0])
    assert list(message.ranges) == [9.0]
    assert list(message.intensities) == [7.0]
    assert type(message) is LaserScan
    message = lazy(_image(), tmp_path)
    message.height = 7
    assert message.data == _image().data


def test_a_buffer_is_an_array_that_may_be_changed_and_stays_the_same_one(tmp_path: Path) -> None:
    message = lazy(_image(), tmp_path)
    message.data[0] = 99
    assert type(message.data) is array
    assert message.data[0] == 99
    assert message.data is message.data
