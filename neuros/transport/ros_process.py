"""The middleware of a process: ROS context, loop and transports of its nodes; topics of peers."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import rclpy
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
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from neuros.ports import EventLoop, NodeEvents, Transport, TransportKind
from neuros.project.model import NodeFile
from neuros.project.names import INTERNAL
from neuros.transport.dds_profile import dds_environment
from neuros.transport.lean_node import (
    Fail,
    LeanNode,
    PluginCallbacks,
    give_up,
    lean_node,
)
from neuros.transport.messages import RosPackets
from neuros.transport.rclpy_patches import do_without_code_generator, keep_to_the_end
from neuros.transport.ros import RosTransport
from neuros.transport.ros_loop import RosLoop

_LINGER_S = 0.05
LEASE_S = 3.0
"""A node elsewhere that has given no sign of life for this long is gone."""

# ROS has DDS announce life after two thirds of the lease that a writer offers: here, every 0.4 s,
# so that seven announcements in a row have to be lost before a node passes for gone.
_OFFERED_S = 0.6
_HEARD_S = 0.5

# Each endpoint that is destroyed is announced to every other process. 64 that end at once would use
# up the 5 s that they have, some of them blocked inside DDS; up to 17 take a fraction of a second.
_CROWD = 16


class RosProcess:
    """ROS in a process: its context, its loop and its ROS nodes.

    It is the :class:`neuros.ports.Middleware` of a node that has its process for itself.

    Args:
        files: the nodes of the process.
    """

    def __init__(
        self,
        files: Sequence[NodeFile],
        on_failure: Callable[[BaseException], None],
        *,
        debug: bool = False,
    ) -> None:
        do_without_code_generator()
        self._files = files
        os.environ.update(dds_environment(os.environ))
        self._context = rclpy.Context()
        # rcl would write each record to a second log file, which costs as much as a packet.
        arguments = ["--ros-args", "--disable-external-lib-logs"]
        for file in files if debug else ():
            arguments += ["--log-level", f"{file.logger_name}:=debug"]
        rclpy.init(
            args=arguments,
            context=self._context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.ros_loop = RosLoop(self._context, on_failure)
        self.loop: EventLoop = self.ros_loop
        self.packets = RosPackets()
        self._ros_nodes: dict[str, LeanNode] = {}
        self._callbacks: list[PluginCallbacks] = []
        self._transports: list[Transport] = []

    def transport(self, file: NodeFile) -> Transport:
        transport = RosTransport(file, self.ros_node(file), self.ros_loop)
        self._transports.append(transport)
        return transport

    def ros_node(self, file: NodeFile) -> LeanNode:
        """The ROS node of a node, made when it is asked for first."""
        name = file.node.name
        if name not in self._ros_nodes:
            self._ros_nodes[name] = lean_node(file, self._context)
            self.ros_loop.add_node(self._ros_nodes[name])
        return self._ros_nodes[name]

    def loop_of(self, file: NodeFile) -> NodeEvents:
        return self.loop

    def begin_anew(
        self, files: Sequence[NodeFile], variables: Mapping[str, Mapping[str, str]]
    ) -> None:
        """Nothing: real time goes on, and is drawn from no seed."""

    def has_node(self, file: NodeFile) -> bool:
        """Whether the ROS node of a node has been made."""
        return file.node.name in self._ros_nodes

    def mark_own_entities(
        self,
        file: NodeFile,
        enter: Callable[[], None],
        fail: Fail,
        thread: int | None = None,
    ) -> None:
        """Remember what exists on a ROS node before its plugin gets hold of it.

        ``thread`` runs the hooks; by default this one.
        """
        ros_node = self.ros_node(file)
        self._callbacks.append(PluginCallbacks(ros_node, self.ros_loop, enter, fail, thread))

    def has_foreign_entities(self, file: NodeFile) -> bool:
        callbacks = self.ros_node(file).callbacks if self.has_node(file) else None
        return callbacks is not None and callbacks.has_any

    def join_peers(
        self,
        names: Sequence[str],
        elsewhere: Sequence[str],
        heard: Callable[[str, str | None], None],
    ) -> PeerStatePublisher:
        namespace = self._files[0].names.namespace
        return PeerStatePublisher(names, elsewhere, self._context, heard, namespace)

    def take_in(self) -> None:
        """Handle what had arrived when the loop ended, but for callbacks of plugins."""
        self._close_callbacks()
        self.ros_loop.take_in()

    def flush(self) -> None:
        """Send and receive nothing any more, and let what was sent last leave."""
        for transport in self._transports:
            transport.close()
        self.ros_loop.run_for(_LINGER_S)

    def close(self, *, may_stay: bool = True) -> None:
        """Close the loop and ROS. In a crowd, ROS may stay open until the process ends.

        Other processes of a crowd then notice after 20 s that this one has gone, as if it had been
        killed; the shared memory of DDS is left to the guardian.
        """
        self._close_callbacks()
        self.ros_loop.close()
        others: set[str] = set()
        for ros_node in [*self._ros_nodes.values()][:1]:  # each lists the whole domain
            others = {*ros_node.get_node_names()} - {*self._ros_nodes}
        if may_stay and len(others) > _CROWD:
            keep_to_the_end(self._ros_nodes.values())
        else:
            give_up(self._context, self._ros_nodes.values())

    def _close_callbacks(self) -> None:
        for callbacks in self._callbacks:
            callbacks.close()


# ---------------------------------------------------------------------- peers


class PeerStatePublisher:
    """Publishes the state of this launcher for its nodes, and receives that of nodes elsewhere.

    It has a thread of its own.

    The nodes of a launcher publish its state (:class:`neuros.launcher.peers.PeerState`), each on a
    topic of its own, ``/neuros/<node>/peer_state`` in the project's namespace: a latched
    ``std_msgs/msg/String``, so that the last state also reaches who comes later. That a node goes
    on living is told by DDS itself (liveliness, OMG DDS 1.4, 2.2.3.11), from threads that need no
    Python: a plugin that holds its global lock for seconds does not pass for dead.

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
            f"_{names[0]}_peer_state",  # a hidden one: tools list it only if asked to
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
                partial(self._receive, name),
                _qos(LEASE_S),
                event_callbacks=SubscriptionEventCallbacks(
                    liveliness=partial(self._on_liveliness, name), use_default_callbacks=False
                ),
            )
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._ros_node)
        self._thread = threading.Thread(target=self._listen, name="neuros-peers", daemon=True)
        self._thread.start()

    def publish(self, text: str) -> None:
        """Publish a state, also for launchers that come later. Any thread."""
        for publisher in self._publishers:
            publisher.publish(String(data=text))

    def close(self) -> None:
        """Let the last state arrive, then destroy the ROS node."""
        for publisher in self._publishers:
            publisher.wait_for_all_acked(Duration(seconds=_HEARD_S))
        self._executor.shutdown(_HEARD_S)
        self._thread.join(_HEARD_S)
        self._ros_node.destroy_node()

    def _listen(self) -> None:
        with contextlib.suppress(ExternalShutdownException):  # the process has given up ROS
            self._executor.spin()

    def _receive(self, name: str, message: String) -> None:
        self._heard(name, message.data)

    def _on_liveliness(self, name: str, life: QoSLivelinessChangedInfo) -> None:
        if life.alive_count_change < 0 or life.not_alive_count_change > 0:
            self._heard(name, None)


def _topic(namespace: str, name: str) -> str:
    return f"{namespace}{INTERNAL}{name}/peer_state"


def _qos(lease_s: float) -> QoSProfile:
    return QoSProfile(
        depth=1,
        reliability=QoSReliabilityPolicy.RELIABLE,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
        liveliness=QoSLivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Duration(seconds=lease_s),
    )


class RosTransportKind(TransportKind):
    """``ros``: nodes in processes of their own, or in containers."""

    name = "ros"
    process: type[RosProcess] = RosProcess

    def middleware(
        self,
        files: Sequence[NodeFile],
        on_failure: Callable[[BaseException], None],
        *,
        digests: bool,
        record: bool,
        debug: bool,
    ) -> RosProcess:
        return self.process(files, on_failure, debug=debug)


ROS = RosTransportKind()
