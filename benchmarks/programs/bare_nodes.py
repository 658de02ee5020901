"""Nodes without NeuROS: rclpy publishers, subscriptions and timers, all in one executor.

``python -m benchmarks.programs.bare_nodes '[{"role": "relay", "from": "a", "to": "b"}, ...]'``
prints ``matched`` as soon as every topic has its ``senders`` and ``receivers`` (1 each unless
said), begins at the first line on its standard input and ends when that is closed. A node that
measures prints what as a line of JSON.
"""

from __future__ import annotations

import functools
import json
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import Imu
from std_msgs.msg import Int64, String

from benchmarks.plugins.arrivals import Arrivals, flood, paced
from benchmarks.plugins.waits import Waits
from benchmarks.programs import MARK

QOS = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE)
PACE_S = 0.01
Description = Mapping[str, Any]


class Part:
    """A node of the graph; ``take`` gets what arrives, ``begin`` is called when all are there."""

    kind: Any = String

    def __init__(self, node: Node, description: Description) -> None:
        self._node = node
        self._senders = description.get("senders", 1)
        self._receivers = description.get("receivers", 1)
        self._publisher = self._subscription = None
        if "to" in description:
            self._publisher = node.create_publisher(self.kind, description["to"], QOS)
        if "from" in description:
            self._subscription = node.create_subscription(
                self.kind, description["from"], self.take, QOS
            )

    def is_matched(self) -> bool:
        """Whether everybody it sends to or receives from has been found."""
        if self._publisher and self._publisher.get_subscription_count() < self._receivers:
            return False
        return not self._subscription or self._subscription.get_publisher_count() >= self._senders

    def begin(self) -> None:
        """Send the first packet, if that is what it does."""

    def take(self, packet: Any) -> None:
        """A packet has arrived."""


class Relay(Part):
    """Sends on what arrives."""

    def take(self, packet: String) -> None:
        self._publisher.publish(packet)


class Ball(Part):
    """Lets one packet go round, ``laps`` times after ``warm_up``; prints microseconds per lap."""

    def __init__(self, node: Node, description: Description) -> None:
        super().__init__(node, description)
        self._count, self._laps = -int(description["warm_up"]), int(description["laps"])
        self._start_ns = 0

    def begin(self) -> None:
        self._publisher.publish(String())

    def take(self, packet: String) -> None:
        self._count += 1
        if self._count == 0:
            self._start_ns = time.perf_counter_ns()
        elif self._count == self._laps:
            show((time.perf_counter_ns() - self._start_ns) / self._laps / 1e3)
            return
        self._publisher.publish(packet)


class Source(Part):
    """Sends ``paced`` packets on a timer, and then one whenever its executor comes round."""

    def __init__(self, node: Node, description: Description) -> None:
        super().__init__(node, description)
        self._paced, self._number = int(description["paced"]), 0
        self._packet = String()

    def begin(self) -> None:
        self._timer = self._node.create_timer(PACE_S, self._pace)

    def _pace(self) -> None:
        if self._paced == 0:
            self._node.destroy_timer(self._timer)
            self._timer = self._node.create_timer(0.0, self._flood)
            return
        self._paced -= 1
        self._packet.data = paced()
        self._publisher.publish(self._packet)

    def _flood(self) -> None:
        self._number += 1
        self._packet.data = flood(self._node.get_name(), self._number)
        self._publisher.publish(self._packet)


class Sink(Part):
    """Counts for ``seconds`` and prints what it has seen."""

    def __init__(self, node: Node, description: Description) -> None:
        super().__init__(node, description)
        self._arrivals, self._is_done = Arrivals(float(description["seconds"])), False

    def take(self, packet: String) -> None:
        if not self._is_done and self._arrivals.take(packet.data):
            self._is_done = True
            show(self._arrivals.result())


class Timer(Part):
    """Notes the moments of ``count`` ticks every ``period_s`` and prints them, in nanoseconds."""

    def __init__(self, node: Node, description: Description) -> None:
        super().__init__(node, description)
        self._period_s, self._count = float(description["period_s"]), int(description["count"])
        self._moments_ns: list[int] = []

    def begin(self) -> None:
        self._node.create_timer(self._period_s, self._tick)

    def _tick(self) -> None:
        self._moments_ns.append(time.monotonic_ns())
        if len(self._moments_ns) == self._count:
            show(self._moments_ns)


class Exchange(Part):
    """Sends an Imu message ten times a second and takes what comes."""

    kind = Imu

    def begin(self) -> None:
        self._node.create_timer(0.1, lambda: self._publisher.publish(Imu()))


class TooFast(Part):
    """Sends the time on the topics ``fast`` and ``other``, at their periods."""

    def __init__(self, node: Node, description: Description) -> None:
        self._node, self._periods_s = node, description["periods_s"]
        self._publishers = [
            node.create_publisher(Int64, name, qos)
            for name, qos in _overload_topics(description["reliable"])
        ]

    def is_matched(self) -> bool:
        return all(each.get_subscription_count() for each in self._publishers)

    def begin(self) -> None:
        for publisher, period_s in zip(self._publishers, self._periods_s, strict=True):
            self._node.create_timer(
                period_s, lambda p=publisher: p.publish(Int64(data=time.monotonic_ns()))
            )


class TooSlow(Part):
    """Takes its time for what :class:`TooFast` sends; prints what ``Waits`` says of it."""

    def __init__(self, node: Node, description: Description) -> None:
        takes_s = dict(zip(("fast", "other"), description["takes_s"], strict=True))
        self._waits, self._is_done = Waits(takes_s, float(description["seconds"])), False
        self._subscriptions = [
            node.create_subscription(Int64, name, functools.partial(self._take, name), qos)
            for name, qos in _overload_topics(description["reliable"])
        ]

    def is_matched(self) -> bool:
        return all(each.get_publisher_count() for each in self._subscriptions)

    def _take(self, name: str, packet: Int64) -> None:
        if not self._is_done and self._waits.take(name, packet.data):
            self._is_done = True
            show(self._waits.result())


def _overload_topics(reliable: Sequence[bool]) -> Iterator[tuple[str, QoSProfile]]:
    for name, is_reliable in zip(("fast", "other"), reliable, strict=True):
        kind = QoSReliabilityPolicy.RELIABLE if is_reliable else QoSReliabilityPolicy.BEST_EFFORT
        yield name, QoSProfile(depth=8 if is_reliable else 1, reliability=kind)


ROLES = {
    "too fast": TooFast,
    "too slow": TooSlow,
    "relay": Relay,
    "ball": Ball,
    "source": Source,
    "sink": Sink,
    "timer": Timer,
    "exchange": Exchange,
}


def show(result: Any) -> None:
    """Print a result."""
    say(json.dumps(result))


def say(text: str) -> None:
    """Print a line that is told from what Fast DDS prints by its mark."""
    print(f"{MARK}{text}", flush=True)


def end_with_input() -> None:
    """End the program when its standard input is closed."""
    sys.stdin.read()
    rclpy.try_shutdown()


def main() -> None:
    """Command line."""
    rclpy.init()
    descriptions = json.loads(sys.argv[1])
    has_events = any(each.get("executor") == "events" for each in descriptions)
    executor = EventsExecutor() if has_events else SingleThreadedExecutor()
    parts = []
    for number, description in enumerate(descriptions):
        node = rclpy.create_node(description.get("name", f"bare_{number}"))
        executor.add_node(node)
        parts.append(ROLES[description["role"]](node, description))
    while not all(part.is_matched() for part in parts):
        time.sleep(0.02)
    say("matched")
    if not sys.stdin.readline():
        return
    threading.Thread(target=end_with_input, daemon=True).start()
    for part in parts:
        part.begin()
    try:
        # Without a timeout, the executor of events spins hot.
        executor.spin_until_future_complete(Future(), timeout_sec=3600)
    except (ExternalShutdownException, RCLError):
        if rclpy.ok():
            raise


if __name__ == "__main__":
    main()
