"""Listener to any topics of the ROS graph, which passes on their messages as bytes.

A subscription gets nothing from a publisher that offers less than it asks for, and misses what was
latched if it asks for less. So it is made as the publishers are, once there is one.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import rclpy
from rclpy.node import Node as RosNode
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.topic_endpoint_info import TopicEndpointInfo

from neuros.errors import EnvironmentFault
from neuros.transport.dds_profile import dds_environment
from neuros.transport.lean_node import LeanNode
from neuros.transport.messages import message_class
from neuros.transport.ros_loop import RosLoop
from neuros.transport.teardown import give_up

_LOOK_S = 0.1
_DEPTH = 1000


@dataclass(frozen=True)
class FoundTopic:
    """A topic with a publisher."""

    name: str
    type: str
    is_reliable: bool
    depth: int
    is_latched: bool = False


class Listener:
    """Listens from :meth:`run` to :meth:`stop`, in whichever thread runs it.

    Args:
        on_found: called once for each topic before its first message; returns what takes those,
            with their wall time in nanoseconds.
        on_refused: is told of a topic that cannot be heard, and why.
        on_failure: is told why nothing more is heard.
    """

    def __init__(
        self,
        topics: Sequence[str],
        on_found: Callable[[FoundTopic], Callable[[int, bytes], None]],
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
        """Listen."""
        os.environ.update(dds_environment(os.environ))
        context = rclpy.Context()
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
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
        qos = QoSProfile(depth=_DEPTH)
        if not is_reliable:
            qos.reliability = QoSReliabilityPolicy.BEST_EFFORT
        if is_latched:
            qos.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL
        take = self._on_found(
            FoundTopic(
                name, type_name, is_reliable, max(q.depth for q in offered) or 10, is_latched
            )
        )
        node.create_subscription(
            kind, name, loop.guarded(lambda data: take(time.time_ns(), data)), qos, raw=True
        )

    def _fail(self, error: BaseException) -> None:
        self._on_failure(str(error))
        self.stop()
