"""Messages on the topics of a connection that are not from its nodes: counted, and not taken."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from launching import start
from rclpy.duration import Duration
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from ros_program import RosProgram
from std_msgs.msg import Int32, String
from std_msgs.msg import UInt64MultiArray as Positions
from test_transports import RosNetwork

from neuros.backends.domain import choose_domain
from neuros.project.model import NodeFile
from neuros.testing.stand_ins import wire
from neuros.testing.transports import TransportBench

LATCHED = QoSProfile(depth=100, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
VOLATILE = QoSProfile(depth=100)
DATA, ACKS, REGISTRATIONS = 50, 5, 2

SOURCE = """
from neuros.hooks import neuros_tick

@neuros_tick(seconds=0.01, outputs="number")
def count(node):
    number = node.make_packet("number")
    number.data = node.get_user_data() or 0
    node.set_user_data(number.data + 1)
    return number
"""
SINK = """
from neuros.hooks import neuros_function

@neuros_function(inputs="number")
def take(node, number):
    seen = node.get_user_data() or []
    seen.append(number.data)
    node.set_user_data(seen)
    if (node.run_dir / "enough").exists():
        node.set_result("seen", seen)
        node.shutdown("that is enough")
"""


@pytest.fixture(scope="module")
def domain() -> Iterator[int]:
    with choose_domain(None, {}, False) as lock:
        yield lock.id


class Intruder(RosProgram):
    """A ROS program that publishes on topics of others."""

    def publish(self, topic: str, qos: QoSProfile, *messages: Any) -> None:
        """Until every reader of the topic has all of them."""
        kind = type(messages[0]) if not isinstance(messages[0], bytes) else Int32
        publisher = self.node.create_publisher(kind, topic, qos)
        self.spin_until(lambda: publisher.get_subscription_count() > 0, 60.0)
        for message in messages:
            publisher.publish(message)
        assert publisher.wait_for_all_acked(Duration(seconds=60))


@pytest.fixture
def intruder(domain: int) -> Iterator[Intruder]:
    with Intruder("intruder", domain) as program:
        yield program


@pytest.mark.parametrize("limit", [0, 3, None])
def test_a_run_goes_on_and_names_who_else_publishes(
    limit: int | None, domain: int, intruder: Intruder, tmp_path: Path
) -> None:
    project = write_project(tmp_path, limit)
    topic = "/neuros/source/number/sink/number"
    folder = tmp_path / "run"
    with start(project, "-d", str(domain), "-o", str(folder), cwd=tmp_path) as running:
        running.wait_for("ROS domain", 60.0)
        intruder.publish(f"{topic}/reg", LATCHED, String(data="ready"), String(data="confirmed"))
        intruder.publish(f"{topic}/data", VOLATILE, *(Int32(data=-1) for _ in range(DATA)))
        if limit is not None:
            intruder.publish(
                f"{topic}/ack", LATCHED, *(Positions(data=[9**n, n]) for n in range(ACKS))
            )
        running.wait_for(f"a message on {topic}/", 30.0)
        running.wait_for("others that publish there: intruder", 30.0)
        (folder / "sink" / "enough").touch()
        run = running.finish(60.0)
    assert run.exit_code == 0, run.output
    connection = run.connection("source.number -> sink.number")
    seen = run.record["nodes"]["sink"]["results"]["seen"]
    assert -1 not in seen
    assert len(seen) == connection["consumed"]
    if limit is None:
        assert connection["foreign"] > 0
    else:
        # Each end hears what is said on /reg.
        assert connection["foreign"] == DATA + ACKS + 2 * REGISTRATIONS
        assert connection["lost"] == 0
    if limit == 0:
        assert seen == list(range(len(seen)))
    assert "foreign" in run.output


def write_project(folder: Path, limit: int | None) -> Path:
    (folder / "source.py").write_text(SOURCE)
    (folder / "sink.py").write_text(SINK)
    number = {"name": "number", "type": "std_msgs/msg/Int32"}
    connection: dict[str, Any] = {
        "source_node": "source",
        "source_output": "number",
        "destination_node": "sink",
        "destination_input": "number",
    }
    if limit is not None:
        connection["discard_limit"] = limit
    nodes = [
        {"name": "source", "plugin": "source.py", "outputs": [number]},
        {"name": "sink", "plugin": "sink.py", "inputs": [number]},
    ]
    nodes = [{**node, "container": "neuros_python"} for node in nodes]
    file = folder / "project.json"
    file.write_text(json.dumps({"nodes": nodes, "connections": [connection]}))
    return file


@pytest.fixture
def bench(domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[TransportBench]:
    """Nodes with the lossless connection ``a.out -> b.in``, registered."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

    def network(files: Any) -> RosNetwork:
        nodes: list[NodeFile] = list(files)
        return RosNetwork([[file] for file in nodes], in_memory=False)

    with TransportBench(network, wire("a.out -> b.in", 0)) as made:
        made.meet()
        yield made


def test_foreign_packets_push_out_none_that_waits(
    bench: TransportBench, intruder: Intruder
) -> None:
    (connection,) = bench.connections
    bench.send(7, connection)
    intruder.publish(f"{connection.topic}/data", VOLATILE, *(Int32(data=-1) for _ in range(90)))
    b = bench.network.transport("b")
    bench.wait(lambda: b.foreign[str(connection)] == 90)
    assert bench.inboxes["b"].numbers(connection) == [7]


def test_foreign_acknowledgements_push_out_none_that_waits(
    bench: TransportBench, intruder: Intruder
) -> None:
    (connection,) = bench.connections
    bench.send(7, connection)
    bench.wait(lambda: bool(bench.inboxes["b"].packets))
    bench.acknowledge(connection, 1)
    intruder.publish(
        f"{connection.topic}/ack", LATCHED, *(Positions(data=[n, n]) for n in range(2, 90))
    )
    a = bench.network.transport("a")
    bench.wait(lambda: a.foreign[str(connection)] == 88)
    assert bench.inboxes["a"].acknowledged == {connection: [1]}


def test_copies_of_packets_are_foreign(bench: TransportBench, intruder: Intruder) -> None:
    (connection,) = bench.connections
    topic = f"{connection.topic}/data"
    heard: dict[bytes, None] = {}
    intruder.node.create_subscription(Int32, topic, lambda d: heard.update({d: None}), 10, raw=True)
    copies = intruder.node.create_publisher(Int32, topic, 10)
    intruder.spin_until(lambda: copies.get_subscription_count() == 2, 60.0)
    values = iter(range(1000))

    def is_heard() -> bool:
        bench.send(next(values), connection)
        intruder.spin()
        return bool(heard)

    bench.wait(is_heard)
    for packet in list(heard) * 20:
        copies.publish(packet)
    b = bench.network.transport("b")
    bench.wait(lambda: b.foreign[str(connection)] >= 20)
    numbers = bench.inboxes["b"].numbers(connection)
    assert numbers == sorted(set(numbers)), "one was taken twice"
