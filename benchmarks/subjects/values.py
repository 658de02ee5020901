"""What the check of a packet costs, which is made before it is sent, on any back end.

Its reference is rclpy's own serialisation of the same message, which checks nothing. A packet that
is right as it is differs from one of which every number has to be converted: both are measured.
"""

from __future__ import annotations

import functools
import time
from array import array
from collections.abc import Callable
from typing import Any

import numpy
from geometry_msgs.msg import Pose, PoseArray, Twist
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image, Imu, JointState, LaserScan, PointCloud2, PointField
from std_msgs.msg import Bool, Header

from benchmarks.measure import Case, Figure, Group, Subject
from neuros.transport.messages import message_class
from neuros.transport.values import checker

_HEADER = Header(frame_id="base_link")
_NAMES = [f"joint_{number}" for number in range(12)]


def subject(is_quick: bool) -> Subject:
    """So many messages per round that each measurement takes some hundredths of a second."""
    count = 200 if is_quick else 2_000
    groups = tuple(
        _group(name, make, count)
        for name, make in (
            ("Bool", lambda: Bool(data=True)),
            ("Twist", Twist),
            ("Twist of NumPy's numbers", _numpy_twist),
            ("Imu", lambda: Imu(header=_HEADER)),
            ("JointState, 12 joints", _joint_state),
            ("LaserScan, 720 ranges", lambda: _laser_scan(1.0)),
            ("LaserScan to be rounded", lambda: _laser_scan(0.1)),
            ("PoseArray, 100 poses", lambda: PoseArray(poses=[Pose() for _ in range(100)])),
            ("Image, 640 x 480", _image),
            ("PointCloud2, 4 fields", _cloud),
        )
    )
    return Subject("check of a packet's values, by message type", groups)


def _group(name: str, make: Callable[[], Any], count: int) -> Group:
    kind = type(make())
    message_class(f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}")
    checked, by_rclpy = f"check of {name}", f"rclpy: {name}"
    candidates = {
        checked: functools.partial(_each_us, make, checker(kind), count),
        by_rclpy: functools.partial(_each_us, make, serialize_message, count),
    }
    reference = Figure(by_rclpy)
    case = Case(checked, "us", Figure(checked), reference, "rclpy's serialize_message")
    return Group(candidates, (case,))


def _each_us(make: Callable[[], Any], handle: Callable[[Any], Any], count: int) -> float:
    """Microseconds per message; each is new, since a check converts it for good."""
    packets = [make() for _ in range(min(count, 2_000_000 // _bytes(make())))]
    handle(make())
    start_ns = time.perf_counter_ns()
    for packet in packets:
        handle(packet)
    return (time.perf_counter_ns() - start_ns) / len(packets) / 1e3


def _bytes(message: Any) -> int:
    return len(serialize_message(checker(type(message))(message)))


def _numpy_twist() -> Twist:
    twist = Twist()
    for vector in (twist.linear, twist.angular):
        vector.x, vector.y, vector.z = numpy.arange(3.0)
    return twist


def _joint_state() -> JointState:
    numbers = array("d", [0.5] * len(_NAMES))
    return JointState(
        header=_HEADER, name=_NAMES, position=numbers, velocity=numbers, effort=numbers
    )


def _laser_scan(angle: float) -> LaserScan:
    return LaserScan(
        header=_HEADER, angle_increment=angle, range_max=angle, ranges=array("f", [1.0]) * 720
    )


def _image() -> Image:
    data = array("B", bytes(640 * 480 * 3))
    return Image(header=_HEADER, height=480, width=640, step=1920, encoding="rgb8", data=data)


def _cloud() -> PointCloud2:
    fields = [
        PointField(name=name, offset=4 * place, datatype=PointField.FLOAT32, count=1)
        for place, name in enumerate(("x", "y", "z", "intensity"))
    ]
    data = array("B", bytes(16_000))
    return PointCloud2(
        header=_HEADER,
        height=1,
        width=1000,
        fields=fields,
        point_step=16,
        row_step=16_000,
        data=data,
    )
