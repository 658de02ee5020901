"""Round trips and floods without NeuROS: plain ``rclpy.spin``, nothing acknowledged.

``python -m benchmarks.programs.bare_rclpy ROLE BALL BACK BYTES [COUNT]``: the types of the packets
there and back, and the size of the one there. Roles:

- ``ping``: prints the durations of COUNT round trips in microseconds, as JSON;
- ``echo``: answers, until its standard input is closed;
- ``both``: both nodes in this process, in one executor; prints the same as ``ping``;
- ``flood``: sends without pause, until its standard input is closed;
- ``count``: prints the packets that arrive per second, over COUNT seconds.
"""

from __future__ import annotations

import contextlib
import importlib
import itertools
import json
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy

from benchmarks.plugins.packets import fill

WARM_UP_PACKETS = 200


@dataclass(frozen=True)
class Packets:
    """What travels: the types there and back, the size there in bytes, and the QoS."""

    ball: type[Any]
    back: type[Any]
    size: int
    depth: int

    @property
    def qos(self) -> QoSProfile:
        """Reliable, so that it is comparable with a discard limit; nothing is acknowledged."""
        return QoSProfile(depth=self.depth, reliability=QoSReliabilityPolicy.RELIABLE)


def echo(node: Node, packets: Packets) -> None:
    """Send back what arrives, or a small packet where another type goes back."""
    publisher = node.create_publisher(packets.back, "back", packets.qos)
    small = fill(packets.back(), 8)
    is_same = packets.ball is packets.back

    def answer(packet: Any) -> None:
        publisher.publish(packet if is_same else small)

    node.create_subscription(packets.ball, "ball", answer, packets.qos)


def ping(node: Node, packets: Packets, wanted: int) -> tuple[list[int], Callable[[], None]]:
    """Moments in nanoseconds at which packets come back, and what serves the first one."""
    moments_ns: list[int] = []
    publisher = node.create_publisher(packets.ball, "ball", packets.qos)
    ball = fill(packets.ball(), packets.size)
    is_same = packets.ball is packets.back

    def strike(packet: Any) -> None:
        moments_ns.append(time.perf_counter_ns())
        if len(moments_ns) <= wanted:
            publisher.publish(packet if is_same else ball)
        else:
            rclpy.try_shutdown()

    subscription = node.create_subscription(packets.back, "back", strike, packets.qos)

    def serve() -> None:
        while not (publisher.get_subscription_count() and subscription.get_publisher_count()):
            time.sleep(0.05)
        time.sleep(0.5)  # a match on one side says nothing about the other
        publisher.publish(ball)

    return moments_ns, serve


def flood(node: Node, packets: Packets) -> None:
    """Send without pause until ROS is shut down."""
    publisher = node.create_publisher(packets.ball, "ball", packets.qos)
    ball = fill(packets.ball(), packets.size)
    while rclpy.ok():
        publisher.publish(ball)


def count(node: Node, packets: Packets, seconds: float) -> float:
    """Packets per second that arrive."""
    moments_ns: list[int] = []

    def take(packet: Any) -> None:
        moments_ns.append(time.perf_counter_ns())
        if moments_ns[-1] - moments_ns[:WARM_UP_PACKETS][-1] > seconds * 1e9:
            rclpy.try_shutdown()

    node.create_subscription(packets.ball, "ball", take, packets.qos)
    spin(node)
    counted = moments_ns[WARM_UP_PACKETS - 1 :]
    return (len(counted) - 1) / (counted[-1] - counted[0]) * 1e9


def spin(*nodes: Node) -> None:
    """Until ROS is shut down."""
    with contextlib.suppress(ExternalShutdownException):
        if len(nodes) == 1:
            rclpy.spin(nodes[0])
            return
        executor = SingleThreadedExecutor()
        for node in nodes:
            executor.add_node(node)
        executor.spin()


def shut_down_at_end_of_input() -> None:
    """Let the end of standard input end this process, so that none is left behind."""

    def wait() -> None:
        sys.stdin.read()
        rclpy.try_shutdown()

    threading.Thread(target=wait, daemon=True).start()


def message(name: str) -> type[Any]:
    """The class of a message type in ROS notation."""
    package, kind, message = name.split("/")
    found: type[Any] = getattr(importlib.import_module(f"{package}.{kind}"), message)
    return found


def main(role: str, ball: str, back: str, size: str, depth: str, wanted: str = "0") -> None:
    """Run one role."""
    packets = Packets(message(ball), message(back), int(size), int(depth))
    rclpy.init()
    shut_down_at_end_of_input()
    nodes = [rclpy.create_node(f"bare_{role}")]
    if role == "echo":
        echo(nodes[0], packets)
        spin(*nodes)
    elif role == "flood":
        with contextlib.suppress(ExternalShutdownException, rclpy.exceptions.InvalidHandle):
            flood(nodes[0], packets)
    elif role == "count":
        print(json.dumps(count(nodes[0], packets, float(wanted))))
    else:
        if role == "both":
            nodes.append(rclpy.create_node("bare_echo"))
            echo(nodes[1], packets)
        moments_ns, serve = ping(nodes[0], packets, int(wanted))
        serve()
        spin(*nodes)
        print(json.dumps([(b - a) / 1e3 for a, b in itertools.pairwise(moments_ns)]))


if __name__ == "__main__":
    main(*sys.argv[1:])
