"""Visual types of packets, by their message types."""

from __future__ import annotations

import math
from typing import Any

import pytest
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Odometry
from neuros_dashboard.visual_types import Mark, Numbers, Picture, Points, Pose, VisualTypes
from sensor_msgs.msg import Image, Imu, LaserScan
from std_msgs.msg import Float64, String

from neuros.node.sampling import Sampler


def seen(source: VisualTypes, packet: Any) -> list[Mark]:
    """What is shown of a packet that a real node has sampled."""
    sampler = Sampler(bytes)
    sampler.ask({"o": source.wanted()})
    sampler.sample("o", packet)
    return list(source.marks(sampler.ask({})["o"]))


def test_a_pose_stands_in_the_world() -> None:
    packet = PoseStamped()
    packet.pose.position.x, packet.pose.orientation.w = 2.0, 0.0
    packet.pose.orientation.z = 1.0
    (pose,) = seen(VisualTypes("geometry_msgs/msg/PoseStamped"), packet)
    assert isinstance(pose, Pose)
    assert (pose.position, pose.orientation) == ((2.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))


def test_a_point_is_a_pose_that_is_not_turned() -> None:
    (pose,) = seen(VisualTypes("geometry_msgs/msg/Point"), Point(x=1.0, y=2.0, z=3.0))
    assert isinstance(pose, Pose)
    assert (pose.position, pose.orientation) == ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))


def test_odometry_is_where_it_is() -> None:
    packet = Odometry()
    packet.pose.pose.position.y = 4.0
    (pose,) = seen(VisualTypes("nav_msgs/msg/Odometry"), packet)
    assert isinstance(pose, Pose)
    assert pose.position == (0.0, 4.0, 0.0)


def test_of_an_imu_the_turn_is_in_the_world_and_the_rates_are_curves() -> None:
    packet = Imu()
    packet.orientation.w = 0.0  # not filled in
    packet.angular_velocity.z = 0.5
    pose, numbers = seen(VisualTypes("sensor_msgs/msg/Imu"), packet)
    assert isinstance(pose, Pose)
    assert pose.orientation == (0.0, 0.0, 0.0, 1.0)
    assert isinstance(numbers, Numbers)
    assert numbers.values["angular_velocity.z"] == 0.5
    assert len(numbers.values) == 6


def test_an_image_is_a_picture() -> None:
    packet = Image(width=1, height=1, step=1, encoding="mono8", data=[7])
    (picture,) = seen(VisualTypes("sensor_msgs/msg/Image"), packet)
    assert isinstance(picture, Picture)
    assert picture.image["encoding"] == "mono8"


def test_a_scan_is_points_without_what_is_out_of_range() -> None:
    packet = LaserScan(angle_min=0.0, angle_increment=math.pi / 2, range_min=0.5, range_max=5.0)
    packet.ranges = [1.0, 2.0, math.inf, 9.0]
    (points,) = seen(VisualTypes("sensor_msgs/msg/LaserScan"), packet)
    assert isinstance(points, Points)
    assert [tuple(round(v, 6) for v in each) for each in points.positions] == [
        (1.0, 0.0, 0.0),
        (0.0, 2.0, 0.0),
    ]


def test_of_an_unknown_type_numbers_are_found_and_then_shown() -> None:
    source = VisualTypes("std_msgs/msg/Float64")
    assert seen(source, Float64(data=1.0)) == []
    (numbers,) = seen(source, Float64(data=2.0))
    assert isinstance(numbers, Numbers)
    assert numbers.values == {"data": 2.0}


def test_what_is_not_measured_in_the_first_packet_is_shown_once_it_is() -> None:
    source = VisualTypes("std_msgs/msg/Float64")
    assert seen(source, Float64(data=math.nan)) == []
    (numbers,) = seen(source, Float64(data=2.0))
    assert isinstance(numbers, Numbers)
    assert numbers.values == {"data": 2.0}


def test_of_what_has_no_numbers_nothing_is_asked_twice() -> None:
    source = VisualTypes("std_msgs/msg/String")
    assert seen(source, String(data="words")) == []
    assert source.wanted() == {"fields": []}
    assert not source.has_numbers


@pytest.mark.parametrize(
    ("type_name", "is_in_space", "is_image", "has_numbers"),
    [
        ("geometry_msgs/msg/Pose", True, False, False),
        ("sensor_msgs/msg/Imu", True, False, True),
        ("sensor_msgs/msg/LaserScan", True, False, False),
        ("sensor_msgs/msg/CompressedImage", False, True, False),
        ("std_msgs/msg/Float64", False, False, True),
        ("rosgraph_msgs/msg/Clock", False, False, False),
    ],
)
def test_each_type_has_its_place(
    type_name: str, is_in_space: bool, is_image: bool, has_numbers: bool
) -> None:
    source = VisualTypes(type_name)
    assert (source.is_in_space, source.is_image, source.has_numbers) == (
        is_in_space,
        is_image,
        has_numbers,
    )
