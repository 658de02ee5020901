"""The round trip without NeuROS: ``rclpy.spin`` in two processes, nothing acknowledged.

``python -m benchmarks.bare_rclpy ping 5000`` prints all durations in microseconds, as JSON;
``python -m benchmarks.bare_rclpy echo`` answers until its standard input is closed.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import sys
import threading
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from std_msgs.msg import String

QOS = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE)


def echo(node: Node) -> None:
    """Send back what arrives."""
    publisher = node.create_publisher(String, "back", QOS)
    node.create_subscription(String, "ball", publisher.publish, QOS)

    def wait_for_end() -> None:
        sys.stdin.read()
        rclpy.try_shutdown()

    threading.Thread(target=wait_for_end, daemon=True).start()
    spin(node)


def ping(node: Node, wanted: int) -> list[float]:
    """Durations of round trips in microseconds."""
    moments_ns: list[int] = []
    publisher = node.create_publisher(String, "ball", QOS)

    def strike(packet: String) -> None:
        moments_ns.append(time.perf_counter_ns())
        if len(moments_ns) <= wanted:
            publisher.publish(packet)
        else:
            rclpy.try_shutdown()

    subscription = node.create_subscription(String, "back", strike, QOS)
    while not (publisher.get_subscription_count() and subscription.get_publisher_count()):
        time.sleep(0.05)
    time.sleep(0.5)  # a match on one side says nothing about the other
    publisher.publish(String())
    spin(node)
    return [(later - earlier) / 1e3 for earlier, later in itertools.pairwise(moments_ns)]


def spin(node: Node) -> None:
    """Until ROS is shut down."""
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


def main() -> None:
    """Command line."""
    role, *arguments = sys.argv[1:]
    rclpy.init()
    node = rclpy.create_node(f"bare_{role}")
    if role == "echo":
        echo(node)
    else:
        print(json.dumps(ping(node, int(arguments[0]))))


if __name__ == "__main__":
    main()
