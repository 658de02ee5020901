"""The ROS node that a plugin gets: others may reach its parameters once it has some."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

from neuros.transport.lean_node import LeanNode, give_up
from neuros.transport.messages import message_class

message_class("std_msgs/msg/Int32")  # loads parts of ROS that warn, where warnings are errors


@pytest.fixture
def node() -> Iterator[LeanNode]:
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = LeanNode("robot", context)
    yield node
    give_up(context, [node])


TYPE_DESCRIPTIONS = ["robot/get_type_description"]


def services(node: LeanNode) -> list[str]:
    return [service.srv_name for service in node.services]


def test_a_node_without_parameters_offers_no_services_for_them(node: LeanNode) -> None:
    assert services(node) == TYPE_DESCRIPTIONS
    assert node.get_parameter("use_sim_time").value is False


def test_the_first_parameter_brings_the_services_for_all(node: LeanNode) -> None:
    assert node.declare_parameter("speed", 3).value == 3
    assert node.declare_parameter("colour", "red").value == "red"
    assert len(services(node)) == 6 + len(TYPE_DESCRIPTIONS)
    assert node.get_parameter("speed").value == 3
