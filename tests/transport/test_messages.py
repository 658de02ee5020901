"""A copy is what a receiver in another process would get; a new message, what its class makes."""

from __future__ import annotations

import math
import subprocess
import sys
from array import array
from typing import Any

import numpy
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped, PoseWithCovariance, Vector3Stamped
from nav_msgs.msg import Odometry, Path
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Image, Imu, JointState, LaserScan, PointCloud2, PointField
from std_msgs.msg import (
    Bool,
    Byte,
    ByteMultiArray,
    ColorRGBA,
    Empty,
    Float32,
    Float32MultiArray,
    Float64,
    Float64MultiArray,
    Header,
    Int8,
    MultiArrayDimension,
    MultiArrayLayout,
    String,
    UInt64,
)

from neuros.transport.messages import copy_packet, make_packet, message_class
from neuros.transport.values import checker

HEADER = Header(stamp=Time(sec=-3, nanosec=999_999_999), frame_id="base")
FILLED = [
    Empty(),
    String(data="hello"),
    String(data="grüße"),
    Bool(data=True),
    Byte(data=b"\x07"),
    Int8(data=-128),
    UInt64(data=2**64 - 1),
    Float32(data=0.1),
    Float64(data=-0.0),
    Imu(header=HEADER, orientation_covariance=numpy.arange(9.0)),
    PoseStamped(header=HEADER),
    Image(header=HEADER, height=1, width=2, encoding="rgb8", data=array("B", range(6))),
    JointState(name=["a", "b"], position=array("d", [0.1, math.inf])),
    LaserScan(ranges=array("f", [0.5])),
    Path(poses=[PoseStamped(header=HEADER), PoseStamped()]),
    Odometry(child_frame_id="x", pose=PoseWithCovariance(covariance=numpy.ones(36))),
    CameraInfo(k=numpy.eye(3).ravel(), d=array("d", [1.0])),
    PointCloud2(fields=[PointField(name="x", datatype=7)], data=array("B", b"abcd")),
    Float32MultiArray(data=array("f", [0.1])),
    Float64MultiArray(layout=MultiArrayLayout(dim=[MultiArrayDimension(label="row", size=2)])),
    ByteMultiArray(data=[b"a"]),
    ColorRGBA(r=0.1),
]
UNUSUAL = [
    Float64(data=numpy.float64(0.1)),
    Float32(data=1 / 3),
    UInt64(data=True),
    Float64MultiArray(data=[1.0, 2.0]),
    JointState(name=("a", "b")),
]
TYPES = [
    "std_msgs/msg/Empty",
    "std_msgs/msg/String",
    "std_msgs/msg/Byte",
    "std_msgs/msg/ColorRGBA",
    "std_msgs/msg/Float64MultiArray",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/PoseStamped",
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/Path",
    "shape_msgs/msg/Mesh",
    "shape_msgs/msg/SolidPrimitive",
]


@pytest.fixture(autouse=True, scope="module")
def loaded_classes() -> None:
    """As a transport loads them, which keeps ROS's deprecation warnings to itself."""
    for kind in {type(packet) for packet in FILLED + UNUSUAL} | {Point, Vector3Stamped}:
        message_class(f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}")


def travelled(packet: Any) -> Any:
    return deserialize_message(serialize_message(packet), type(packet))


def parts(packet: Any) -> list[tuple[type, Any]]:
    """All that a message consists of, with the exact classes."""
    if hasattr(packet, "get_fields_and_field_types"):
        inner = [getattr(packet, name) for name in packet.get_fields_and_field_types()]
    elif isinstance(packet, list):
        inner = packet
    else:
        return [(type(packet), packet.tolist() if hasattr(packet, "tolist") else packet)]
    return [(type(packet), len(inner)), *(part for each in inner for part in parts(each))]


@pytest.mark.parametrize("packet", FILLED + UNUSUAL, ids=repr)
def test_a_copy_is_equal_in_value_and_class_to_what_travels_as_bytes(packet: Any) -> None:
    packet = checker(type(packet))(packet)
    assert repr(parts(copy_packet(packet))) == repr(parts(travelled(packet)))


def test_nothing_that_can_change_is_shared() -> None:
    packet = Path(header=Header(frame_id="map"), poses=[PoseStamped()])
    imu, image = Imu(), Image(data=array("B", b"abc"))
    copies = copy_packet(packet), copy_packet(imu), copy_packet(image)
    packet.poses[0].pose.position.x = 1.0
    packet.poses.append(PoseStamped())
    packet.header.stamp.sec = 7
    imu.orientation_covariance[0] = 5.0
    image.data[0] = 0
    assert copies[0] == Path(header=Header(frame_id="map"), poses=[PoseStamped()])
    assert copies[1] == Imu()
    assert copies[2].data == array("B", b"abc")


def test_a_copy_is_filled_like_any_other_message() -> None:
    copy = copy_packet(Point(x=1.0))
    copy.x = 2.0
    assert copy == Point(x=2.0)


@pytest.mark.parametrize("type_name", TYPES)
def test_a_new_message_has_the_values_and_classes_of_the_constructor(
    type_name: str,
) -> None:
    kind = message_class(type_name)
    made, constructed = make_packet(type_name), kind()
    assert made == constructed
    assert repr(made) == repr(constructed)
    assert classes(made) == classes(constructed)


def classes(value: Any) -> list[type]:
    slots = getattr(value, "__slots__", ())
    return [type(value), *(kind for slot in slots for kind in classes(getattr(value, slot)))]


def parts_that_can_change(value: Any) -> set[int]:
    parts = [getattr(value, slot) for slot in getattr(value, "__slots__", ())]
    own = {id(value)} if parts or isinstance(value, list | array | numpy.ndarray) else set()
    return own.union(*map(parts_that_can_change, parts))


@pytest.mark.parametrize("type_name", ["sensor_msgs/msg/Imu", "nav_msgs/msg/Path"])
def test_two_new_messages_share_nothing_that_can_change(type_name: str) -> None:
    made = make_packet(type_name), make_packet(type_name)
    assert parts_that_can_change(made[0]).isdisjoint(parts_that_can_change(made[1]))
    made[0].header.frame_id = "changed"
    assert made[1] == message_class(type_name)()


def test_a_node_imports_no_parser_of_message_definitions() -> None:
    """A package of ROS that messages import would bring it: a seventh of a node's imports."""
    program = (
        "import sys; from neuros.transport.rclpy_patches import do_without_code_generator as do;"
        " do(); import rosidl_generator_py as it; from rclpy.type_support import"
        " check_for_type_support; from std_msgs.msg import String;"
        " check_for_type_support(String); print(hasattr(it, 'generate_py'), 'lark' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout == "False False\n"
