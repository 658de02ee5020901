"""Topics on which the launchers of one project hear each other's state.

The nodes of a launcher publish its state (:class:`neuros.launcher.peers.PeerState`), each on a
topic of its own, ``/neuros/<node>/side`` in the project's namespace: a latched
``std_msgs/msg/String``, so that the last state also reaches who comes later. That a node goes
on living is told by DDS itself (liveliness, OMG DDS 1.4, 2.2.3.11), from threads that need no
Python: a plugin that holds its global lock for seconds does not pass for dead.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from functools import partial

from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import QoSLivelinessChangedInfo, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node as RosNode
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSLivelinessPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)
from std_msgs.msg import String

from neuros.project.names import INTERNAL

LEASE_S = 3.0
"""A node elsewhere that has given no sign of life for this long is gone."""

# ROS has DDS announce life after two thirds of the lease that a writer offers: here, every 0.4 s,
# so that seven announcements in a row have to be lost before a node passes for gone.
_OFFERED_S = 0.6
_HEARD_S = 0.5


class PeerVoice:
    """Speaks for nodes of this process, and listens to nodes elsewhere, in a thread of its own.

    Args:
        names: the nodes of this process.
        elsewhere: nodes that other launchers start.
        heard: called from the thread with a node elsewhere and its launcher's state, or
            ``None`` when it is gone.
        namespace: that of the project.
    """

    def __init__(
        self,
        names: Sequence[str],
        elsewhere: Sequence[str],
        context: Context,
        heard: Callable[[str, str | None], None],
        namespace: str = "",
    ) -> None:
        self._heard = heard
        self._ros_node = RosNode(
            f"_{names[0]}_side",  # a hidden one: tools do not list it unless they are asked to
            context=context,
            namespace=namespace,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._publishers = [
            self._ros_node.create_publisher(String, _topic(namespace, name), _qos(_OFFERED_S))
            for name in names
        ]
        for name in elsewhere:
            self._ros_node.create_subscription(
                String,
                _topic(namespace, name),
                partial(self._hear, name),
                _qos(LEASE_S),
                event_callbacks=SubscriptionEventCallbacks(
                    liveliness=partial(self._count, name), use_default_callbacks=False
                ),
            )
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._ros_node)
        self._thread = threading.Thread(target=self._listen, name="neuros-side", daemon=True)
        self._thread.start()

    def say(self, text: str) -> None:
        """Let it be heard elsewhere, also by who comes later. Any thread."""
        for publisher in self._publishers:
            publisher.publish(String(data=text))

    def close(self) -> None:
        """Let the last state arrive, then be silent."""
        for publisher in self._publishers:
            publisher.wait_for_all_acked(Duration(seconds=_HEARD_S))
        self._executor.shutdown(_HEARD_S)
        self._thread.join(_HEARD_S)
        self._ros_node.destroy_node()

    def _listen(self) -> None:
        with contextlib.suppress(ExternalShutdownException):  # the process has given up ROS
            self._executor.spin()

    def _hear(self, name: str, message: String) -> None:
        self._heard(name, message.data)

    def _count(self, name: str, life: QoSLivelinessChangedInfo) -> None:
        if life.alive_count_change < 0 or life.not_alive_count_change > 0:
            self._heard(name, None)


def _topic(namespace: str, name: str) -> str:
    return f"{namespace}{INTERNAL}{name}/side"


def _qos(lease_s: float) -> QoSProfile:
    return QoSProfile(
        depth=1,
        reliability=QoSReliabilityPolicy.RELIABLE,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
        liveliness=QoSLivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Duration(seconds=lease_s),
    )
