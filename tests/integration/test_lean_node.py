"""The ROS node that a plugin gets: others may reach its parameters once it has some."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

from neuros.transport.lean_node import LeanNode, give_up
from neuros.transport.messages import message_class

message_class("std_msgs/msg/Int32")  # before ROS loads more for it, parts that warn


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


LOGS = """
import rclpy
from rclpy.logging import get_logger
from neuros.transport.lean_node import LeanNode, give_up

context = rclpy.Context()
rclpy.init(context=context)
node = LeanNode("robot", context)

def log(logger):
    logger.info("plain")
    logger.warn("deprecated")
    logger.log("by number", 40)
    logger.debug("never")
    for _ in range(2):
        logger.info("one of two", once=True)
    logger.fatal("another", once=True)

log(node.get_logger())
log(get_logger("robot"))
give_up(context, [node])
"""


def test_the_logger_says_what_that_of_ros_says_and_from_where() -> None:
    shown = {"RCUTILS_CONSOLE_OUTPUT_FORMAT": "{severity} {message} {function_name}:{line_number}"}
    done = subprocess.run(
        [sys.executable, "-c", LOGS],
        env={**os.environ, **shown},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=True,
    )
    said = ["INFO plain log:11", "WARN deprecated log:12", "ERROR by number log:13"]
    said += ["INFO one of two log:16", "FATAL another log:17"]
    assert done.stdout.splitlines() == [*said, *said]


def test_a_message_costs_no_search_of_all_modules(
    node: LeanNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    def search(*_: Any) -> None:
        pytest.fail("all modules are searched")

    monkeypatch.setattr(inspect, "getframeinfo", search)
    assert node.get_logger().info("found")
