"""Endpoints of others that DDS does not connect to an external topic, since their QoS does not fit.

A subscription gets nothing from a publisher that offers less than it asks for (OMG DDS 1.4,
2.2.3). DDS tells both ends that there is such a pair; what the other one wants, the graph knows.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rclpy.node import Node as RosNode
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo

from neuros.project.model import Port
from neuros.transport.ros_loop import RosLoop

_LOOK_S = 0.3
_MOST_LOOKS = 20
"""What DDS has told of, the graph lists a moment later; seconds later on a machine under load."""

_ADVICE = 'give both the same, with "qos" in the project'


class Mismatches:
    """Warns in a node's log of those that cannot be connected to one of its ports, once each.

    Args:
        topic: its full name.
        own: what the port offers or asks for.
    """

    def __init__(
        self, ros_node: RosNode, loop: RosLoop, port: Port, topic: str, own: QoSProfile
    ) -> None:
        self._ros_node = ros_node
        self._loop = loop
        self._port = port
        self._topic = topic
        self._own = own
        self._named: set[bytes] = set()

    def on_publisher(self, event: Any) -> None:
        """DDS has found a publisher that offers less than this input asks for."""
        self._look_later(event, is_input=True)

    def on_subscription(self, event: Any) -> None:
        """DDS has found a subscription that asks for more than this output offers."""
        self._look_later(event, is_input=False)

    def _look_later(self, event: Any, *, is_input: bool) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        total, looks = event.total_count, 0

        def look() -> None:
            nonlocal looks
            looks += 1
            self._look(is_input=is_input)
            if len(self._named) >= total or looks == _MOST_LOOKS:
                self._ros_node.destroy_timer(timer)
                if not self._named:
                    self._warn_of_somebody("input" if is_input else "output", policy)

        timer = self._loop.every(self._ros_node, _LOOK_S, look)

    def _look(self, *, is_input: bool) -> None:
        if is_input:
            side, list_others = "input", self._ros_node.get_publishers_info_by_topic
        else:
            side, list_others = "output", self._ros_node.get_subscriptions_info_by_topic
        for other in list_others(self._port.external_topic):  # by the name that rules apply to
            offered, asked = (
                (other.qos_profile, self._own) if is_input else (self._own, other.qos_profile)
            )
            lacking = list(differences(offered, asked))
            if lacking:
                self._warn(side, other, lacking)

    def _warn_of_somebody(self, side: str, policy: str) -> None:
        self._ros_node.get_logger().warning(
            f"{side} '{self._port.name}': somebody on {self._topic} cannot be connected: the"
            f" {policy} that one side offers is not what the other asks for"
        )

    def _warn(self, side: str, other: TopicEndpointInfo, lacking: list[tuple[str, str]]) -> None:
        gid = bytes(other.endpoint_gid)
        if gid in self._named:
            return
        self._named.add(gid)
        name = f"{other.node_namespace.rstrip('/')}/{other.node_name}"
        offered = " and ".join(each for each, _ in lacking)
        asked = " and ".join(each for _, each in lacking)
        if side == "input":
            text = f"{name} offers {offered}, and this input asks for {asked}: it hears nothing"
            text += " of that"
        else:
            text = f"{name} asks for {asked}, and this output offers {offered}: it is not heard"
            text += " there"
        self._ros_node.get_logger().warning(
            f"{side} '{self._port.name}': on {self._topic} {text}; {_ADVICE}"
        )


def differences(offered: QoSProfile, asked: QoSProfile) -> Iterator[tuple[str, str]]:
    """Where a publisher offers less than a subscription asks for: ``(offered, asked)`` in words."""
    reliable, best_effort = QoSReliabilityPolicy.RELIABLE, QoSReliabilityPolicy.BEST_EFFORT
    if (offered.reliability, asked.reliability) == (best_effort, reliable):
        yield "best_effort", "reliable"
    latched, volatile = QoSDurabilityPolicy.TRANSIENT_LOCAL, QoSDurabilityPolicy.VOLATILE
    if (offered.durability, asked.durability) == (volatile, latched):
        yield "volatile", "transient_local"
