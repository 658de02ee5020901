"""A message that is made for a plugin is the one that its class would make."""

from __future__ import annotations

from typing import Any

import pytest

from neuros.transport.copying import make_packet
from neuros.transport.messages import message_class
from neuros.transport.ownership import is_unshared_inside

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


@pytest.mark.parametrize("type_name", TYPES)
def test_it_has_the_values_and_classes_that_the_constructor_gives(type_name: str) -> None:
    kind = message_class(type_name)
    made, constructed = make_packet(type_name), kind()
    assert made == constructed
    assert repr(made) == repr(constructed)
    assert classes(made) == classes(constructed)


def classes(value: Any) -> list[type]:
    slots = getattr(value, "__slots__", ())
    return [type(value), *(kind for slot in slots for kind in classes(getattr(value, slot)))]


@pytest.mark.parametrize("type_name", ["sensor_msgs/msg/Imu", "nav_msgs/msg/Path"])
def test_two_of_them_share_nothing_that_can_change(type_name: str) -> None:
    made = make_packet(type_name), make_packet(type_name)
    assert all(is_unshared_inside(each) for each in made)
    made[0].header.frame_id = "changed"
    assert made[1] == message_class(type_name)()
