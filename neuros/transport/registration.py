"""How the two ends of a connection find each other before the first packet.

DDS matches a writer and a reader on each side separately and at different times, and what is sent
before both have matched may vanish without a trace. So each end looks at its own endpoints: the
receiver announces itself on ``/reg`` once its data reader has matched the sender's writer and its
acknowledgement writer the sender's reader; the sender, once the same holds the other way round
and it has heard the announcement, counts the connection as registered and confirms.

A number of matches says nothing about *who* matched (a recorder and ``ros2 topic echo`` do, too).
An end is taken as found when the ROS graph lists an endpoint of that very node, and all compatible
endpoints that the graph lists are matched.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rclpy.node import Node as RosNode
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_msgs.msg import String

from neuros.project.model import Connection

LATCHED = QoSProfile(
    depth=1,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
)
"""QoS of ``/reg`` and ``/ack``: the last message also reaches who comes later."""

HEARD = QoSProfile(
    depth=10,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
)
"""QoS of the reader of ``/reg``: both ends speak there, so it keeps more than the last word."""

_READY = "ready"
_CONFIRMED = "confirmed"


class Registration:
    """One connection, seen from one of its ends.

    Args:
        note: what a receiver lets its sender know of itself, one line.
        on_registered: called once, in the loop's thread, when this end is sure of the other;
            a sender gets the receiver's note, a receiver an empty one.
    """

    def __init__(
        self,
        ros_node: RosNode,
        connection: Connection,
        *,
        publishers: list[Publisher],
        subscriptions: list[Subscription],
        is_sender: bool,
        note: str = "",
        on_registered: Callable[[str], None],
    ) -> None:
        self.connection = connection
        self.is_done = False
        self._ros_node = ros_node
        self._publishers = publishers
        self._subscriptions = subscriptions
        self._is_sender = is_sender
        self._peer = connection.destination_node if is_sender else connection.source_node
        self._on_registered = on_registered
        self._announcement = f"{_READY} {note}"
        self._peer_is_ready = False
        self._peer_note = ""
        topic = f"{connection.topic}/reg"
        self._voice = ros_node.create_publisher(String, topic, LATCHED)
        self._ear = ros_node.create_subscription(String, topic, self._hear, HEARD)

    def advance(self) -> bool:
        """Look again, announce or confirm where it is time; returns whether all is done."""
        if self.is_done or not self._has_found_peer():
            return self.is_done
        if not self._is_sender:
            self._voice.publish(String(data=self._announcement))
        elif self._peer_is_ready:
            self._voice.publish(String(data=_CONFIRMED))
            self._finish()
        return self.is_done

    def close(self) -> None:
        """Give up the endpoints."""
        self._ros_node.destroy_publisher(self._voice)
        self._ros_node.destroy_subscription(self._ear)

    def _hear(self, message: String) -> None:
        word, _, note = message.data.partition(" ")
        if self._is_sender and word == _READY:
            self._peer_is_ready = True
            self._peer_note = note
            if self.is_done:  # the confirmation may have been sent before the ear was there
                self._voice.publish(String(data=_CONFIRMED))
            else:
                self.advance()
        elif not self._is_sender and word == _CONFIRMED and not self.is_done:
            self._finish()

    def _finish(self) -> None:
        self.is_done = True
        self._on_registered(self._peer_note)

    def _has_found_peer(self) -> bool:
        return all(self._reaches_peer(publisher) for publisher in self._publishers) and all(
            self._hears_peer(subscription) for subscription in self._subscriptions
        )

    def _reaches_peer(self, publisher: Publisher) -> bool:
        matched = publisher.get_subscription_count()
        if not matched:  # asked first: the graph is searched from end to end for each topic
            return False
        listed = self._ros_node.get_subscriptions_info_by_topic(publisher.topic_name)
        compatible = [e for e in listed if _match(publisher.qos_profile, e.qos_profile)]
        return self._is_among(compatible, matched)

    def _hears_peer(self, subscription: Subscription) -> bool:
        matched = subscription.get_publisher_count()
        if not matched:
            return False
        listed = self._ros_node.get_publishers_info_by_topic(subscription.topic_name)
        compatible = [e for e in listed if _match(e.qos_profile, subscription.qos_profile)]
        return self._is_among(compatible, matched)

    def _is_among(self, compatible: Sequence[TopicEndpointInfo], matched: int) -> bool:
        return matched >= len(compatible) and any(e.node_name == self._peer for e in compatible)


def _match(publisher: QoSProfile, subscription: QoSProfile) -> bool:
    """Whether DDS matches these two.

    ``rclpy.qos.qos_check_compatible`` takes the "infinite" deadline that the graph reports for one
    that was asked for, and so refuses all that the graph lists.
    """
    is_reliable = publisher.reliability == QoSReliabilityPolicy.RELIABLE
    is_latched = publisher.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
    wants_reliable = subscription.reliability == QoSReliabilityPolicy.RELIABLE
    wants_latched = subscription.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
    return (is_reliable or not wants_reliable) and (is_latched or not wants_latched)
