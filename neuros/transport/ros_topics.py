"""Topics of the ROS graph as bytes: a listener, for the recorder, and a player of recorded ones."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node as RosNode
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.validate_full_topic_name import validate_full_topic_name

from neuros.errors import EnvironmentFault
from neuros.transport.dds_profile import RANGE_VARIABLE, dds_environment
from neuros.transport.lean_node import LeanNode, give_up
from neuros.transport.messages import message_class
from neuros.transport.ros_loop import RosLoop

_LOOK_S = 0.1
_LAST_S = 5.0
_POLL_S = 0.01
# A connection's own depth goes with acknowledgements, which a player does not get.
_DEPTH = 1000
_LONGEST_SLEEP_S = 3600.0  # times of a damaged bag may be centuries apart
_DEEPEST = (1 << 31) - 1  # DDS has 32 bits for it


@dataclass(frozen=True)
class RosTopic:
    """A topic: its message type, and what its publishers offer."""

    name: str
    type: str
    is_reliable: bool
    depth: int
    is_latched: bool = False


def _context(domain_id: int | None = None) -> Context:
    """A new ROS context, with NeuROS's settings of DDS."""
    os.environ.update(dds_environment(os.environ))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain_id, signal_handler_options=SignalHandlerOptions.NO)
    return context


def _qos(topic: RosTopic, depth: int) -> QoSProfile:
    reliability, durability = QoSReliabilityPolicy, QoSDurabilityPolicy
    return QoSProfile(
        depth=depth,
        reliability=reliability.RELIABLE if topic.is_reliable else reliability.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if topic.is_latched else durability.VOLATILE,
    )


class Listener:
    """Listens to topics from :meth:`run` to :meth:`stop`, in whichever thread runs it.

    A subscription gets nothing from a publisher that offers less than it asks for, and misses what
    was latched if it asks for less. So it is made as the publishers are, once there is one.

    Args:
        on_found: called once for each topic before its first message; returns what takes those,
            with their wall time in nanoseconds.
        on_refused: is told of a topic that cannot be heard, and why.
        on_failure: is told why nothing more is heard.
    """

    def __init__(
        self,
        topics: Sequence[str],
        on_found: Callable[[RosTopic], Callable[[int, bytes], None]],
        on_refused: Callable[[str, str], object],
        on_failure: Callable[[str], object],
    ) -> None:
        self._missing = list(topics)
        self._on_found = on_found
        self._on_refused = on_refused
        self._on_failure = on_failure
        self._is_stopping = False
        self._loop: RosLoop | None = None

    def run(self) -> None:
        context = _context()
        node = LeanNode("neuros_recorder", context)
        loop = RosLoop(context, self._fail)
        loop.add_node(node)
        node.create_timer(_LOOK_S, lambda: loop.guard(lambda: self._look(node, loop)))
        self._loop = loop
        if not self._is_stopping:
            loop.run()
        loop.close()
        give_up(context, [node])

    def stop(self) -> None:
        """Have :meth:`run` return. Any thread."""
        self._is_stopping = True
        if self._loop is not None:
            self._loop.stop()

    def _look(self, node: RosNode, loop: RosLoop) -> None:
        """Subscribe to topics that have a publisher now."""
        for name in tuple(self._missing):
            publishers = node.get_publishers_info_by_topic(name)
            if publishers:
                self._missing.remove(name)
                self._subscribe(node, loop, name, publishers)

    def _subscribe(
        self, node: RosNode, loop: RosLoop, name: str, publishers: Sequence[TopicEndpointInfo]
    ) -> None:
        type_name = publishers[0].topic_type
        try:
            kind = message_class(type_name)
        except EnvironmentFault as error:
            self._on_refused(name, str(error))
            return
        offered = [publisher.qos_profile for publisher in publishers]
        is_reliable = all(q.reliability == QoSReliabilityPolicy.RELIABLE for q in offered)
        is_latched = all(q.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL for q in offered)
        depth = max(q.depth for q in offered) or 10
        topic = RosTopic(name, type_name, is_reliable, depth, is_latched)
        take = self._on_found(topic)
        handle = loop.guarded(lambda data: take(time.time_ns(), data))
        node.create_subscription(kind, name, handle, _qos(topic, _DEPTH), raw=True)

    def _fail(self, error: BaseException) -> None:
        self._on_failure(str(error))
        self.stop()


def _check(topic: RosTopic) -> None:
    """Raise ``EnvironmentFault`` for a topic that cannot be published: a bag may say anything."""
    try:
        validate_full_topic_name(topic.name)
    except InvalidTopicNameException as error:
        why = " ".join(str(error).splitlines()[0].split())
        raise EnvironmentFault(f"topic {topic.name!r} cannot be published: {why}") from None
    if not 0 <= topic.depth <= _DEEPEST:
        raise EnvironmentFault(f"topic {topic.name} cannot be published with depth {topic.depth}")


def play(
    topics: Sequence[RosTopic],
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
        EnvironmentFault: if a message type is not installed here, or a topic cannot be published.
    """
    kinds = [message_class(topic.type) for topic in topics]
    for topic in topics:
        _check(topic)
    os.environ.setdefault(RANGE_VARIABLE, "LOCALHOST")
    context = _context(domain_id)
    node = LeanNode("neuros_replay", context)
    publishers = {}
    for topic, kind in zip(topics, kinds, strict=True):
        # What is latched reaches who comes later: no more of it than in the run.
        depth = topic.depth if topic.is_latched else max(topic.depth, _DEPTH)
        publishers[topic.name] = node.create_publisher(kind, topic.name, _qos(topic, depth))
    try:
        while any(each.get_subscription_count() < subscriptions for each in publishers.values()):
            time.sleep(_POLL_S)
        time.sleep(delay_s)
        count = 0
        start_s, first_ns = time.monotonic(), None
        for at_ns, name, data in packets:
            first_ns = at_ns if first_ns is None else first_ns
            due_s = start_s + (at_ns - first_ns) / 1e9 / rate
            while (wait_s := due_s - time.monotonic()) > 0:
                time.sleep(min(wait_s, _LONGEST_SLEEP_S))
            publishers[name].handle.publish_raw(data)
            count += 1
        for publisher in publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=_LAST_S))
        return count
    finally:
        give_up(context, [node])
