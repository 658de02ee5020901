"""The external topics of one node: plain ROS topics, with the QoS that the project asks for."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node as RosNode
from rclpy.publisher import Publisher
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSPresetProfiles,
    QoSProfile,
    QoSReliabilityPolicy,
)
from rclpy.subscription import Subscription

from neuros.ports import Inbox
from neuros.project.model import NodeFile, Port
from neuros.project.qos import ASKED, OFFERED, PRESETS, Qos
from neuros.transport.codecs import message_codec
from neuros.transport.messages import message_class
from neuros.transport.mismatches import Mismatches
from neuros.transport.ros_loop import RosLoop
from neuros.transport.silent_topics import warn_of_silence


class ExternalTopics:
    """Publishers and subscriptions of the ports with an external topic."""

    def __init__(self, file: NodeFile, ros_node: RosNode, loop: RosLoop) -> None:
        self._file = file
        self._ros_node = ros_node
        self._loop = loop
        self._publishers: dict[str, Publisher] = {}
        self._is_open = False

    def open(self, inbox: Inbox) -> None:
        """Create the endpoints, and watch whether others can be connected to them."""
        self._is_open = True
        for port in self._file.node.outputs:
            if port.external_topic is not None:
                self._publishers[port.name] = self._publisher(port, port.external_topic)
        heard = {
            port: self._subscription(port, port.external_topic, inbox)
            for port in self._file.node.inputs
            if port.external_topic is not None
        }
        if heard:
            self._loop.expect_arrivals()
            warn_of_silence(self._ros_node, heard, self._loop)

    def send(self, port: Port, packet: Any) -> None:
        """Publish on the external topic of an output."""
        if self._is_open:
            self._publishers[port.name].publish(packet)

    def close(self) -> None:
        """Publish and receive nothing any more; the endpoints go with their ROS node."""
        self._is_open = False

    def _publisher(self, port: Port, topic: str) -> Publisher:
        profile = qos_profile(port.qos or OFFERED)
        mismatches = Mismatches(self._ros_node, self._loop, port, self._full(topic), profile)
        return self._ros_node.create_publisher(
            message_class(port.type),
            topic,
            profile,
            event_callbacks=PublisherEventCallbacks(incompatible_qos=mismatches.on_subscription),
        )

    def _subscription(self, port: Port, topic: str, inbox: Inbox) -> Subscription:
        kind = message_class(port.type)
        profile = qos_profile(port.qos or ASKED)
        mismatches = Mismatches(self._ros_node, self._loop, port, self._full(topic), profile)
        return self._ros_node.create_subscription(
            kind,
            topic,
            self._loop.guarded(self._receiver(kind, partial(inbox.on_external_packet, port))),
            profile,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=mismatches.on_publisher),
            raw=True,
        )

    def _receiver(self, kind: type, deliver: Callable[[Any], None]) -> Callable[[bytes], None]:
        decode = message_codec(kind).decode

        def receive(data: bytes) -> None:
            if self._is_open:
                deliver(decode(data))

        return receive

    def _full(self, topic: str) -> str:
        return self._file.names.resolve(topic, self._file.node.name)


def qos_profile(qos: Qos) -> QoSProfile:
    """The profile of rclpy for what a project file says."""
    for name in ("system_default", "best_available"):
        if qos == PRESETS[name]:
            preset: QoSProfile = QoSPresetProfiles.get_from_short_key(name)
            return preset
    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=qos.depth,
        reliability=QoSReliabilityPolicy.get_from_short_key(qos.reliability),
        durability=QoSDurabilityPolicy.get_from_short_key(qos.durability),
    )
