"""Player of serialised messages: publishes them on the ROS graph at given times."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import rclpy
from rclpy.duration import Duration
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from neuros.transport.dds_profile import RANGE_VARIABLE, dds_environment
from neuros.transport.lean_node import LeanNode
from neuros.transport.messages import message_class
from neuros.transport.teardown import give_up

_LAST_S = 5.0
_POLL_S = 0.01
# A connection's own depth goes with acknowledgements, which the player does not get.
_DEPTH = 1000


@dataclass(frozen=True)
class PlayedTopic:
    """A topic to publish on: its message type, and what is offered to subscribers."""

    type: str
    is_reliable: bool
    depth: int
    is_latched: bool = False


def play(
    topics: Mapping[str, PlayedTopic],
    packets: Iterable[tuple[int, str, bytes]],
    *,
    rate: float,
    delay_s: float,
    subscriptions: int,
    domain_id: int | None,
) -> int:
    """Publish packets; returns how many.

    Args:
        packets: time in nanoseconds, topic and CDR, in the order of time.
        rate: times as fast as they were recorded.
        delay_s: how long subscribers have to find the publishers before the first packet.
        subscriptions: how many every topic must have before that, however long it takes.

    Raises:
        EnvironmentFault: if a message type is not installed here.
    """
    kinds = {name: message_class(topic.type) for name, topic in topics.items()}
    os.environ.setdefault(RANGE_VARIABLE, "LOCALHOST")
    os.environ.update(dds_environment(os.environ))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain_id, signal_handler_options=SignalHandlerOptions.NO)
    node = LeanNode("neuros_replay", context)
    publishers = {
        name: node.create_publisher(kinds[name], name, _qos(topic))
        for name, topic in topics.items()
    }
    try:
        while any(each.get_subscription_count() < subscriptions for each in publishers.values()):
            time.sleep(_POLL_S)
        time.sleep(delay_s)
        count = 0
        start_s, first_ns = time.monotonic(), None
        for at_ns, name, data in packets:
            first_ns = at_ns if first_ns is None else first_ns
            wait_s = start_s + (at_ns - first_ns) / 1e9 / rate - time.monotonic()
            if wait_s > 0:
                time.sleep(wait_s)
            publishers[name].handle.publish_raw(data)
            count += 1
        for publisher in publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=_LAST_S))
        return count
    finally:
        give_up(context, [node])


def _qos(topic: PlayedTopic) -> QoSProfile:
    profile = QoSProfile(depth=max(topic.depth, _DEPTH))
    if not topic.is_reliable:
        profile.reliability = QoSReliabilityPolicy.BEST_EFFORT
    if topic.is_latched:
        profile.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL
        profile.depth = topic.depth  # what who comes later gets
    return profile
