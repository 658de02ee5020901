"""A packet that cannot be sent: which field is to blame."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import PoseArray, PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Int8, String

from neuros.runtime.wrong_fields import wrong_field


def test_a_packet_of_right_values_has_none():
    assert wrong_field(PoseStamped()) == ""
    assert wrong_field(JointState(name=["a"], position=[1.0])) == ""


@pytest.mark.parametrize(
    ("packet", "path", "value", "text"),
    [
        (String(), "data", 5, "field 'data' must be string, but is 5 (int)"),
        (Int8(), "data", 200, "field 'data' must be int8, but is 200 (int)"),
        (
            PoseStamped(),
            "pose.position.x",
            1,
            "field 'pose.position.x' must be double, but is 1 (int)",
        ),
        (JointState(), "name", "hip", "field 'name' must be sequence<string>, but is 'hip' (str)"),
    ],
)
def test_the_field_is_named_with_its_type_and_what_it_holds(packet, path, value, text):
    *parents, name = path.split(".")
    message = packet
    for parent in parents:
        message = getattr(message, parent)
    setattr(message, name, value)
    assert wrong_field(packet) == text


def test_a_field_within_a_list_is_named_with_its_place():
    poses = PoseArray(poses=[PoseStamped().pose, PoseStamped().pose])
    poses.poses[1].position.z = "up"
    assert wrong_field(poses) == "field 'poses[1].position.z' must be double, but is 'up' (str)"
