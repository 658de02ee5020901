"""A workbench for transports: three nodes that do what a check tells them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from neuros.ports import Transport
from neuros.project.model import Connection, Folders, Node, NodeFile, Port
from neuros.testing.wiring import numbered

NUMBER, SERIES = "std_msgs/msg/Int32", "std_msgs/msg/Float64MultiArray"
TOPIC = "/transport_checks/said"
TIMEOUT_S = 20.0


class Network(Protocol):
    """Some nodes joined by the transport under test, each with its transport still closed."""

    def transport(self, node: str) -> Transport:
        """The transport of a node."""

    def run_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Handle events until ``condition()``; returns False if that took too long."""

    def settle(self) -> None:
        """Handle events until what is under way has certainly arrived."""

    def listen(self, topic: str, type_name: str) -> list[Any] | None:
        """What a plain ROS subscription of another process hears from now on; grows.

        ``None`` where the nodes are not on a ROS graph.
        """

    def close(self) -> None:
        """Close all transports, and end everything."""


class Ear:
    """Writes down what a transport tells (:class:`neuros.ports.Inbox`), in tests.

    ``answers`` are called with each packet, after it has been written down.
    """

    def __init__(self) -> None:
        self.packets: dict[Connection, list[Any]] = {}
        self.external: list[Any] = []
        self.acknowledged: dict[Connection, list[int]] = {}
        self.registered: list[Connection] = []
        self.on_arrival: Callable[[Connection, Any], object] = lambda *_: None
        self.on_credit: Callable[[Connection], object] = lambda _: None
        self.on_meeting: Callable[[Connection], object] = lambda _: None

    def on_packet(self, connection: Connection, packet: Any) -> None:
        self.packets.setdefault(connection, []).append(packet)
        self.on_arrival(connection, packet)

    def on_external_packet(self, port: Port, packet: Any) -> None:
        self.external.append(packet)

    def on_acknowledgement(self, connection: Connection, position: int) -> None:
        self.acknowledged.setdefault(connection, []).append(position)
        self.on_credit(connection)

    def on_registered(self, connection: Connection) -> None:
        self.registered.append(connection)
        self.on_meeting(connection)

    def numbers(self, connection: Connection) -> list[int]:
        """The ``data`` of all packets of a connection."""
        return [packet.data for packet in self.packets.get(connection, ())]


class TransportBench:
    """The nodes ``a``, ``b`` and ``c`` of a check, with the connections that it needs."""

    def __init__(
        self, network: Callable[[Sequence[NodeFile]], Network], *connections: Connection
    ) -> None:
        self.connections = numbered(connections)
        files = [_file(name, self.connections) for name in ("a", "b", "c")]
        self.network = network(files)
        self.ears = {file.node.name: Ear() for file in files}

    def __enter__(self) -> TransportBench:
        return self

    def __exit__(self, *_: object) -> None:
        self.network.close()

    def open(self, *nodes: str) -> None:
        """Open transports."""
        for node in nodes:
            self.network.transport(node).open(self.ears[node])

    def meet(self) -> None:
        """Open all transports, and wait until all connections are registered."""
        self.open("a", "b", "c")
        self.wait(lambda: not self.missing())

    def missing(self) -> set[Connection]:
        """Connections that their sender does not know to be registered."""
        return set(self.connections) - {c for ear in self.ears.values() for c in ear.registered}

    def wait(self, condition: Callable[[], bool]) -> None:
        """Until something holds; fails after a while."""
        assert self.network.run_until(condition, TIMEOUT_S), f"not within {TIMEOUT_S:g} s"

    def send(self, value: int, *connections: Connection) -> None:
        """Send a number on connections of one output."""
        transport = self.network.transport(connections[0].source_node)
        packet = transport.make_packet(NUMBER)
        packet.data = value
        transport.send(connections, packet)

    def acknowledge(self, connection: Connection, position: int) -> None:
        """Acknowledge as the receiver."""
        self.network.transport(connection.destination_node).acknowledge(connection, position)


def _file(name: str, connections: Sequence[Connection]) -> NodeFile:
    node = Node(
        name=name,
        container="neuros_python",
        plugin=Path("plugin.py"),
        inputs=(
            Port("in", NUMBER),
            Port("other", NUMBER),
            Port("series", SERIES),
            *([Port("heard", NUMBER, TOPIC)] if name == "b" else []),
        ),
        outputs=(
            Port("out", NUMBER),
            Port("series", SERIES),
            *([Port("said", NUMBER, TOPIC)] if name == "a" else []),
        ),
    )
    own = tuple(c for c in connections if name in (c.source_node, c.destination_node))
    return NodeFile(node, own, Folders(Path(), Path(), Path()))
