"""Packets over ROS 2 topics: the only use of rclpy on the data path.

A connection has three topics below ``/neuros/<source>/<output>/<destination>/<input>``: ``/data``,
``/ack`` (the position of the last packet that every taker has started on), and ``/reg``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.node import Node as RosNode
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription
from std_msgs.msg import UInt64

from neuros.core.node_ports import EXTERNAL_DEPTH
from neuros.ports import Inbox
from neuros.project.model import Connection, NodeFile, Port
from neuros.transport.messages import message_class
from neuros.transport.registration import LATCHED, Registration
from neuros.transport.ros_loop import RosLoop

_ANNOUNCE_S = 0.02


class RosTransport:
    """Carries the packets of one node over ROS topics."""

    def __init__(self, file: NodeFile, ros_node: RosNode, loop: RosLoop) -> None:
        self._node = file.node
        self._connections = file.connections
        self._ros_node = ros_node
        self._loop = loop
        self._data: dict[Connection, Publisher] = {}
        self._acknowledgements: dict[Connection, tuple[Publisher, UInt64]] = {}
        self._external: dict[str, Publisher] = {}
        self._registrations: list[Registration] = []
        self._is_open = False

    def open(self, inbox: Inbox) -> None:
        """Create all endpoints and look for the other ends until each is found."""
        self._is_open = True
        for connection in self._connections:
            if connection.source_node == connection.destination_node:
                self._loop.post(_call(inbox.on_registered, connection))
            elif connection.source_node == self._node.name:
                self._open_sender(connection, inbox)
            else:
                self._open_receiver(connection, inbox)
        self._open_external(inbox)
        if self._registrations:
            self._timer = self._ros_node.create_timer(
                _ANNOUNCE_S, lambda: self._loop.guard(self._look_for_others)
            )

    def send(self, connections: Sequence[Connection], packet: Any) -> None:
        """Publish a packet on the data topics of these connections, serialised once."""
        if not self._is_open:
            return
        data = packet if len(connections) == 1 else serialize_message(packet)
        for connection in connections:
            self._data[connection].publish(data)

    def send_external(self, port: Port, packet: Any) -> None:
        """Publish on the external topic of an output."""
        if self._is_open:
            self._external[port.name].publish(packet)

    def acknowledge(self, connection: Connection, position: int) -> None:
        """Publish the position that every taker has reached."""
        if self._is_open:
            publisher, message = self._acknowledgements[connection]
            message.data = position
            publisher.publish(message)

    def waiting_for(self) -> Sequence[Connection]:
        """Connections whose other end has not been found yet."""
        return [each.connection for each in self._registrations if not each.is_done]

    def make_packet(self, type_name: str) -> Any:
        """A new message with default values."""
        return message_class(type_name)()

    def close(self) -> None:
        """Publish and receive nothing any more; the endpoints go with their ROS node."""
        self._is_open = False

    def _open_sender(self, connection: Connection, inbox: Inbox) -> None:
        kind = message_class(self._node.output(connection.source_output).type)
        data = self._ros_node.create_publisher(
            kind, f"{connection.topic}/data", data_qos(connection)
        )
        self._data[connection] = data
        subscriptions = []
        if connection.is_reliable:
            subscriptions.append(
                self._subscribe(
                    UInt64,
                    f"{connection.topic}/ack",
                    LATCHED,
                    lambda message: inbox.on_acknowledgement(connection, message.data),
                )
            )
        self._register(
            connection, [data], subscriptions, True, lambda: inbox.on_registered(connection)
        )

    def _open_receiver(self, connection: Connection, inbox: Inbox) -> None:
        kind = message_class(self._node.input(connection.destination_input).type)
        publishers = []
        if connection.is_reliable:
            acknowledge = self._ros_node.create_publisher(
                UInt64, f"{connection.topic}/ack", LATCHED
            )
            self._acknowledgements[connection] = (acknowledge, UInt64())
            publishers.append(acknowledge)
        data = self._subscribe(
            kind,
            f"{connection.topic}/data",
            data_qos(connection),
            partial(inbox.on_packet, connection),
        )
        self._register(connection, publishers, [data], False, lambda: None)

    def _open_external(self, inbox: Inbox) -> None:
        for port in self._node.outputs:
            if port.external_topic is not None:
                self._external[port.name] = self._ros_node.create_publisher(
                    message_class(port.type), port.external_topic, EXTERNAL_DEPTH
                )
        for port in self._node.inputs:
            if port.external_topic is not None:
                self._open_external_input(port, inbox)

    def _open_external_input(self, port: Port, inbox: Inbox) -> None:
        # A best-effort reader matches reliable and best-effort writers.
        qos = QoSProfile(depth=EXTERNAL_DEPTH, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        self._subscribe(
            message_class(port.type),
            str(port.external_topic),
            qos,
            partial(inbox.on_external_packet, port),
        )

    def _subscribe(
        self, kind: type, topic: str, qos: QoSProfile, deliver: Callable[[Any], None]
    ) -> Subscription:
        guard = self._loop.guard

        def receive(message: Any) -> None:
            if self._is_open:
                guard(deliver, message)

        return self._ros_node.create_subscription(kind, topic, receive, qos)

    def _register(
        self,
        connection: Connection,
        publishers: list[Publisher],
        subscriptions: list[Subscription],
        is_sender: bool,
        on_registered: Callable[[], None],
    ) -> None:
        self._registrations.append(
            Registration(
                self._ros_node,
                connection,
                publishers=publishers,
                subscriptions=subscriptions,
                is_sender=is_sender,
                on_registered=lambda: self._loop.post(on_registered),
            )
        )

    def _look_for_others(self) -> None:
        pending = [each for each in self._registrations if not each.advance()]
        if not pending:
            self._ros_node.destroy_timer(self._timer)


def data_qos(connection: Connection) -> QoSProfile:
    """Deep enough for DDS itself to drop nothing that flow control lets through."""
    reliable = QoSReliabilityPolicy.RELIABLE
    best_effort = QoSReliabilityPolicy.BEST_EFFORT
    return QoSProfile(
        depth=connection.window, reliability=reliable if connection.is_reliable else best_effort
    )


def _call(function: Callable[[Connection], None], connection: Connection) -> Callable[[], None]:
    return lambda: function(connection)
