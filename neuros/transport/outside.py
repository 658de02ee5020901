"""What nodes that share a process still have to do with the ROS graph.

External topics go through DDS as always; a data topic is published while somebody listens to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.node import Node as RosNode
from rclpy.publisher import Publisher

from neuros.ports import Inbox
from neuros.project.model import Connection, NodeFile, Port
from neuros.transport.copying import make_packet
from neuros.transport.external import ExternalTopics
from neuros.transport.messages import message_class
from neuros.transport.ros import data_qos
from neuros.transport.ros_loop import RosLoop

_LOOK_S = 0.25


class RosOutside:
    """External topics and listeners of one node whose connections stay within the process.

    Attributes:
        heard: the connections that somebody listens to; looked up four times per second.
    """

    def __init__(self, file: NodeFile, ros_node: RosNode, loop: RosLoop) -> None:
        self._external = ExternalTopics(file, ros_node, loop)
        self._file = file
        self._ros_node = ros_node
        self._loop = loop
        self._publishers: dict[Connection, Publisher] = {}
        self.heard: frozenset[Connection] = frozenset()

    def open(self, inbox: Inbox) -> None:
        """Create the endpoints."""
        self._external.open(inbox)
        for connection in self._file.connections:
            if connection.source_node == self._file.node.name:
                self._publishers[connection] = self._ros_node.create_publisher(
                    message_class(self._file.node.output(connection.source_output).type),
                    f"{connection.topic}/data",
                    data_qos(connection),
                )
        if self._publishers:
            self._loop.every(self._ros_node, _LOOK_S, self._look)

    def show(self, connections: Sequence[Connection], packet: Any) -> None:
        """Publish a packet for those who listen."""
        for connection in connections:
            if connection in self.heard:
                self._publishers[connection].publish(packet)

    def send_external(self, port: Port, packet: Any) -> None:
        """Publish on the external topic of an output."""
        self._external.send(port, packet)

    def make_packet(self, type_name: str) -> Any:
        """A new message with default values."""
        return make_packet(type_name)

    def close(self) -> None:
        """Publish and receive nothing any more."""
        self.heard = frozenset()
        self._external.close()

    def _look(self) -> None:
        self.heard = frozenset(
            connection
            for connection, publisher in self._publishers.items()
            if publisher.get_subscription_count()
        )
