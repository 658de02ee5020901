"""What each transport guarantees."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from neuros.ports import Transport
from neuros.project.model import Connection, Folders, Node, NodeFile, Port
from neuros.testing.harness import numbered, wire
from neuros.transport.messages import make_packet

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


class RecordingInbox:
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

    def on_acknowledgement(
        self, connection: Connection, position: int, arrival_ns: int | None = None
    ) -> None:
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
        self.inboxes = {file.node.name: RecordingInbox() for file in files}

    def __enter__(self) -> TransportBench:
        return self

    def __exit__(self, *_: object) -> None:
        self.network.close()

    def open(self, *nodes: str) -> None:
        """Open transports."""
        for node in nodes:
            self.network.transport(node).open(self.inboxes[node])

    def meet(self) -> None:
        """Open all transports, and wait until all connections are registered."""
        self.open("a", "b", "c")
        self.wait(lambda: not self.missing())

    def missing(self) -> set[Connection]:
        """Connections that their sender does not know to be registered."""
        return set(self.connections) - {
            c for inbox in self.inboxes.values() for c in inbox.registered
        }

    def wait(self, condition: Callable[[], bool]) -> None:
        """Until something holds; fails after a while."""
        assert self.network.run_until(condition, TIMEOUT_S), f"not within {TIMEOUT_S:g} s"

    def send(self, value: int, *connections: Connection) -> None:
        """Send a number on connections of one output."""
        packet = make_packet(NUMBER)
        packet.data = value
        self.network.transport(connections[0].source_node).sender(connections)(packet)

    def acknowledge(self, connection: Connection, position: int) -> None:
        """Acknowledge as the receiver."""
        self.network.transport(connection.destination_node).acknowledger(connection)(position)


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


class TransportChecks:
    """What a transport guarantees; pytest collects the methods from a derived class."""

    def network(self, files: Sequence[NodeFile]) -> Network:
        """Join these nodes."""
        raise NotImplementedError

    def test_lossless_packets_arrive_in_order_and_acknowledgements_come_back(self) -> None:
        count = 50
        with TransportBench(self.network, wire("a.out -> b.in", 0)) as bench:
            (connection,) = bench.connections
            a, b = bench.inboxes["a"], bench.inboxes["b"]
            b.on_arrival = lambda c, packet: bench.acknowledge(c, packet.data)

            def go_on(c: Connection) -> None:
                if a.acknowledged[c][-1] < count:
                    bench.send(a.acknowledged[c][-1] + 1, c)

            a.on_credit = go_on
            bench.meet()
            bench.send(1, connection)
            bench.wait(lambda: a.acknowledged.get(connection, [0])[-1] == count)
            bench.network.settle()
            assert b.numbers(connection) == list(range(1, count + 1))
            assert a.acknowledged[connection] == list(range(1, count + 1))

    def test_a_whole_window_sent_at_once_arrives(self) -> None:
        with TransportBench(self.network, wire("a.out -> b.in", 5, queue_size=3)) as bench:
            (connection,) = bench.connections
            bench.meet()
            for first in (0, 8, 16):
                for value in range(first, first + 8):
                    bench.send(value, connection)
                expected = list(range(first + 8))
                bench.wait(lambda e=expected: bench.inboxes["b"].numbers(connection) == e)  # type: ignore[misc]
                bench.acknowledge(connection, first + 8)
            bench.wait(lambda: bench.inboxes["a"].acknowledged.get(connection, [0])[-1] == 24)

    def test_the_first_packet_after_registration_arrives(self) -> None:
        with TransportBench(
            self.network, wire("a.out -> b.in", 0), wire("b.out -> a.in", 0)
        ) as bench:
            for inbox in bench.inboxes.values():
                inbox.on_meeting = lambda c: bench.send(7, c)
                inbox.on_arrival = lambda c, _: bench.acknowledge(c, 1)
            bench.meet()
            there, back = bench.connections
            a, b = bench.inboxes["a"], bench.inboxes["b"]
            bench.wait(lambda: b.numbers(there) == [7] and a.numbers(back) == [7])
            bench.wait(lambda: a.acknowledged == {there: [1]} and b.acknowledged == {back: [1]})

    def test_a_connection_is_registered_once_and_only_when_the_receiver_is_there(self) -> None:
        with TransportBench(self.network, wire("a.out -> b.in", 0), wire("a.out -> c.in")) as bench:
            late, early = bench.connections
            a = bench.inboxes["a"]
            bench.open("a", "c")
            bench.wait(lambda: early in a.registered)
            bench.network.settle()
            assert a.registered == [early]
            assert bench.network.transport("a").waiting_for() == [late]
            bench.open("b")
            bench.wait(lambda: late in a.registered)
            bench.wait(lambda: not bench.network.transport("b").waiting_for())
            bench.network.settle()
            assert a.registered == [early, late]
            assert bench.network.transport("a").waiting_for() == []

    def test_a_receiver_knows_which_senders_are_missing(self) -> None:
        with TransportBench(self.network, wire("a.out -> b.in", 0)) as bench:
            bench.open("b")
            bench.network.settle()
            assert bench.network.transport("b").waiting_for() == list(bench.connections)

    def test_every_receiver_of_an_output_gets_every_packet(self) -> None:
        wires = wire("a.out -> b.in", 0), wire("a.out -> b.other", 2), wire("a.out -> c.in", 0)
        with TransportBench(self.network, *wires) as bench:
            bench.meet()
            b, c = bench.inboxes["b"], bench.inboxes["c"]
            for inbox in (b, c):
                inbox.on_arrival = lambda connection, packet: bench.acknowledge(
                    connection, packet.data
                )
            for value in (1, 2, 3):
                bench.send(value, *bench.connections)
                bench.wait(
                    lambda v=value: all(  # type: ignore[misc]
                        bench.inboxes["a"].acknowledged.get(each, [0])[-1] == v
                        for each in bench.connections
                    )
                )
            for inbox, each in zip((b, b, c), bench.connections, strict=True):
                assert inbox.numbers(each) == [1, 2, 3]

    def test_best_effort_never_holds_anybody_up(self) -> None:
        with TransportBench(self.network, wire("a.out -> b.in")) as bench:
            (connection,) = bench.connections
            b = bench.inboxes["b"]
            bench.meet()
            for value in range(100):
                bench.send(value, connection)
            bench.wait(lambda: 99 in b.numbers(connection))
            assert b.numbers(connection) == sorted(set(b.numbers(connection)))
            assert bench.inboxes["a"].acknowledged == {}

    def test_what_one_does_to_a_packet_nobody_else_sees(self) -> None:
        wires = wire("a.series -> b.series", 0), wire("a.series -> c.series", 0)
        with TransportBench(self.network, *wires) as bench:
            bench.meet()

            def spoil(_: Connection, packet: Any) -> None:
                seen.append(list(packet.data))
                packet.data[0] = -1.0
                packet.layout.data_offset = 1

            seen: list[list[float]] = []
            bench.inboxes["b"].on_arrival = bench.inboxes["c"].on_arrival = spoil
            transport = bench.network.transport("a")
            packet = make_packet(SERIES)
            packet.data = [1.0, 2.0]
            transport.sender(bench.connections)(packet)
            packet.data[1] = -2.0
            bench.wait(lambda: len(seen) == 2)
            assert seen == [[1.0, 2.0], [1.0, 2.0]]
            assert list(packet.data) == [1.0, -2.0]
            assert packet.layout.data_offset == 0

    def test_a_large_packet_arrives(self) -> None:
        with TransportBench(self.network, wire("a.series -> b.series", 0)) as bench:
            bench.meet()
            transport = bench.network.transport("a")
            packet = make_packet(SERIES)
            packet.data = [float(i) for i in range(1 << 17)]  # 1 MiB
            transport.sender(bench.connections)(packet)
            b = bench.inboxes["b"]
            bench.wait(lambda: bool(b.packets))
            assert b.packets[bench.connections[0]] == [packet]

    def test_after_closing_nothing_is_sent_or_heard(self) -> None:
        with TransportBench(
            self.network, wire("a.out -> b.in", 0), wire("c.out -> b.other", 0)
        ) as bench:
            first, second = bench.connections
            bench.meet()
            bench.network.transport("a").close()
            bench.send(1, first)
            bench.send(2, second)
            b = bench.inboxes["b"]
            bench.wait(lambda: b.numbers(second) == [2])
            bench.network.settle()
            assert b.numbers(first) == []
            bench.network.transport("b").close()
            bench.acknowledge(second, 1)
            bench.send(3, second)
            bench.network.settle()
            assert b.numbers(second) == [2]
            assert bench.inboxes["c"].acknowledged == {}

    def test_ordinary_ros_tools_hear_every_connection(self) -> None:
        with TransportBench(self.network, wire("a.out -> b.in", 0)) as bench:
            (connection,) = bench.connections
            bench.meet()
            heard = bench.network.listen(f"{connection.topic}/data", NUMBER)
            if heard is None:
                return
            values = iter(range(1000))

            def is_heard() -> bool:
                bench.send(next(values), connection)
                return bool(heard)

            bench.wait(is_heard)
            first = heard[0].data
            bench.send(-1, connection)
            bench.wait(lambda: heard[-1].data == -1)
            assert first in bench.inboxes["b"].numbers(connection)

    def test_external_topics_reach_everybody(self) -> None:
        with TransportBench(self.network) as bench:
            bench.open("a", "b")
            heard = bench.network.listen(TOPIC, NUMBER)
            if heard is None:
                return
            transport = bench.network.transport("a")
            packet = make_packet(NUMBER)
            packet.data = 5

            def is_heard() -> bool:
                transport.send_external(Port("said", NUMBER, TOPIC), packet)
                return bool(heard and bench.inboxes["b"].external)

            bench.wait(is_heard)
            assert bench.inboxes["b"].external[0].data == heard[0].data == 5
