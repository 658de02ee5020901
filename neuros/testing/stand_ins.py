"""Stand-ins for ROS in tests of plugins: node, logger, transport, event loop and clock."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

from neuros.errors import NodeError
from neuros.ports import Inbox, Transport
from neuros.project.message_types import in_full, normalised
from neuros.project.model import Connection, Node, NodeFile, Port, Value
from neuros.transport.lean_node import Parameter, ParameterNotDeclaredException
from neuros.transport.memory import MemoryHub, MemoryTransport
from neuros.transport.messages import RosPackets, copy_packet
from neuros.transport.null_middleware import WithoutPeers

Event = Callable[[], None]
_LEVELS = {
    "DEBUG": logging.DEBUG,
    "INFO": logging.INFO,
    "WARN": logging.WARNING,
    "ERROR": logging.ERROR,
    "FATAL": logging.CRITICAL,
}
_NOTHING: Mapping[str, Value] = MappingProxyType({})


class ManualClock:
    """A monotonic clock in nanoseconds; it starts at 0."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns


class StepLoop:
    """Handles events in the order of posting (:class:`neuros.ports.EventLoop`).

    All packets go through this one queue, so a loop-back arrives after all waiting events without a
    queue of its own.
    """

    has_taken_in = True

    def __init__(self, clock: ManualClock) -> None:
        self._clock = clock
        self._events: deque[Event] = deque()
        self._timers: list[tuple[Callable[[], int | None], Event]] = []
        self._is_stopping = False

    @property
    def has_waiting_events(self) -> bool:
        return bool(self._events)

    def post(self, event: Event) -> None:
        """Handle ``event`` after all waiting events; callable from any thread."""
        self._events.append(event)

    post_loop_back = post_from_thread = post

    def note_execution(self) -> None:
        """Nothing arrives during an execution."""

    def add_timer(self, next_due_ns: Callable[[], int | None], on_due: Event) -> None:
        """Call ``on_due`` when :meth:`advance_to` reaches ``next_due_ns()``."""
        self._timers.append((next_due_ns, on_due))

    @property
    def next_due_ns(self) -> int | None:
        """The time of the next timer, or ``None``."""
        dues = [due for next_due_ns, _ in self._timers if (due := next_due_ns()) is not None]
        return min(dues, default=None)

    def advance_to(self, time_ns: int) -> None:
        """Set the clock, and run the timers that are due."""
        self._clock.now_ns = time_ns
        for next_due_ns, on_due in self._timers:
            due_ns = next_due_ns()
            if due_ns is not None and due_ns <= time_ns:
                on_due()

    def step(self) -> bool:
        """Handle the oldest event; returns False if there was none."""
        if self._is_stopping or not self._events:
            return False
        self._events.popleft()()
        return True

    def run(self) -> None:
        """Handle events until none is left, or until :meth:`stop`."""
        while self.step():
            pass

    def stop(self) -> None:
        """Handle no further event."""
        self._is_stopping = True


class Record(NamedTuple):
    """A line of a node's log; ``severity`` is DEBUG, INFO, WARN, ERROR or FATAL."""

    severity: str
    text: str


class RecordingLogger:
    """A stand-in for rclpy's logger that keeps every record, and passes it on to ``logging``.

    ``once``, ``skip_first`` and ``throttle_duration_sec`` are accepted and have no effect.
    """

    def __init__(self, name: str, records: list[Record]) -> None:
        self.name = name
        self._records = records
        self._python = logging.getLogger(f"neuros.{name}")

    def get_child(self, name: str) -> RecordingLogger:
        """A child logger with the same list of records."""
        return RecordingLogger(f"{self.name}.{name}", self._records)

    def debug(self, message: str, **_: Any) -> bool:
        return self._keep("DEBUG", message)

    def info(self, message: str, **_: Any) -> bool:
        return self._keep("INFO", message)

    def warning(self, message: str, **_: Any) -> bool:
        return self._keep("WARN", message)

    warn = warning

    def error(self, message: str, **_: Any) -> bool:
        return self._keep("ERROR", message)

    def fatal(self, message: str, **_: Any) -> bool:
        return self._keep("FATAL", message)

    def _keep(self, severity: str, message: str) -> bool:
        self._records.append(Record(severity, str(message)))
        self._python.log(_LEVELS[severity], "%s", message)
        return True


class RosNodeStandIn:
    """The result of ``node.get_ros_node()`` in a test: name, logger and parameters, without ROS.

    Args:
        topics: by name of the node's topics: type, number of publishers, number of subscribers.
    """

    def __init__(
        self,
        name: str,
        records: list[Record],
        parameters: Mapping[str, Value] = _NOTHING,
        topics: Mapping[str, tuple[str, int, int]] = MappingProxyType({}),
    ) -> None:
        self._topics = topics
        self._name = name
        self._parameters: dict[str, Any] = dict(parameters)
        self._given = {*parameters}
        self._logger = RecordingLogger(name, records)

    def get_name(self) -> str:
        return self._name

    def get_logger(self) -> RecordingLogger:
        """The logger whose records are ``harness.log``."""
        return self._logger

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        """The topics of the node's own ports."""
        return [(name, [topic[0]]) for name, topic in sorted(self._topics.items())]

    def count_publishers(self, name: str) -> int:
        """The number of publishers: the node, or the test."""
        return self._topics[name][1]

    def count_subscribers(self, name: str) -> int:
        return self._topics[name][2]

    def has_parameter(self, name: str) -> bool:
        return name in self._parameters

    def get_parameter(self, name: str) -> Parameter:
        """A parameter that the project, or the plugin, has declared."""
        if name not in self._parameters:
            raise ParameterNotDeclaredException(name)
        return Parameter(name, value=self._parameters[name])

    def declare_parameter(self, name: str, value: Any = None, *_: Any, **__: Any) -> Parameter:
        """Declare a parameter as in rclpy; a value of the project wins."""
        if name not in self._given:
            self._parameters[name] = value
        return self.get_parameter(name)

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("__"):  # copy and pickle look for such attributes
            raise AttributeError(attribute)
        raise NodeError(
            f"get_ros_node().{attribute}: there is no ROS behind a PluginHarness, only"
            " get_logger(), get_name() and parameters: test this part in a project that is launched"
        )


class Topics:
    """External topics in a test (``GraphBridge`` of a transport); published packets are kept."""

    heard: tuple[Connection, ...] = ()

    def __init__(self) -> None:
        self.inbox: Inbox | None = None
        self.published: dict[str, list[Any]] = {}

    def open(self, inbox: Inbox) -> None:
        """Deliver to this inbox."""
        self.inbox = inbox

    def deliver(self, port: Port, packet: Any) -> None:
        """Deliver a packet to the input of an external topic."""
        if self.inbox is not None:
            self.inbox.on_external_packet(port, packet)

    def send_external(self, port: Port, packet: Any) -> None:
        """Keep a packet."""
        self.published.setdefault(port.name, []).append(copy_packet(packet))

    def show(self, connections: Sequence[Connection], packet: Any) -> None:
        """The test has no ROS tools that subscribe."""

    def close(self) -> None:
        """Drop further packets."""
        self.inbox = None


class Workbench(WithoutPeers):
    """The middleware of one node under test (:class:`neuros.ports.Middleware`)."""

    def __init__(self, loop: StepLoop, topics: Topics, log: list[Record]) -> None:
        self.loop = loop
        self.topics = topics
        self.packets = RosPackets()
        self.hub = MemoryHub(loop, self.packets.copier)
        self._log = log
        self._ros_nodes: dict[str, RosNodeStandIn] = {}

    def transport(self, file: NodeFile) -> Transport:
        """The transport of nodes that share a process, as in runs."""
        self._ros_nodes[file.node.name] = RosNodeStandIn(
            file.node.name, self._log, file.node.parameters, _topics_of(file)
        )
        return MemoryTransport(file, self.hub, self.topics)

    def ros_node(self, file: NodeFile) -> RosNodeStandIn:
        """The node's stand-in."""
        return self._ros_nodes[file.node.name]

    def close(self) -> None:
        """There is nothing to release."""


def _topics_of(file: NodeFile) -> dict[str, tuple[str, int, int]]:
    """The topics of a node's ports, as on the ROS graph."""
    node = file.node
    found = {}
    for c in file.connections:
        is_output = c.source_node == node.name
        port = node.output(c.source_output) if is_output else node.input(c.destination_input)
        found[f"{c.topic}/data"] = (port.type, 1, 1)
    for is_output, ports in ((True, node.outputs), (False, node.inputs)):
        for port in ports:
            if port.external_topic is not None:
                name = file.names.resolve(port.external_topic, node.name)
                found[name] = (port.type, int(is_output), int(not is_output))
    return found


# ---------------------------------------------------------------------- wiring
#
# The surroundings of a node under test: its ports, and the neighbours it is connected to.


SENDER, RECEIVER, OBSERVER = "sender", "receiver", "observer"
_MANY = 1_000_000


def wire(text: str, discard_limit: int | None = None, queue_size: int = 1) -> Connection:
    """A connection, written ``"camera.image -> node.view"``; without limit it is best effort.

    >>> wire("camera.image -> node.view", discard_limit=0).is_reliable
    True
    """
    ends = [end.strip().split(".") for end in text.split("->")]
    if [len(end) for end in ends] != [2, 2] or not all(part for end in ends for part in end):
        raise ValueError(f"{text!r} is not a connection: write 'node.output -> node.input'")
    (source, output), (destination, input_name) = ends
    return Connection(source, output, destination, input_name, discard_limit, queue_size)


def ports(types: Mapping[str, str]) -> tuple[Port, ...]:
    """Ports from their names and message types, in either notation."""
    found = []
    for name, written in types.items():
        type_name = normalised(in_full(written))
        if type_name is None:
            raise ValueError(
                f"'{name}': {written!r} is not a message type: write it like 'std_msgs/msg/String'"
            )
        found.append(Port(name, type_name))
    return tuple(found)


def with_neighbours(node: Node, connections: Sequence[Connection]) -> tuple[Connection, ...]:
    """Add a lossless connection for each port that has none: from ``sender``, to ``receiver``.

    Raises ``ValueError`` for a given connection that does not fit the node.
    """
    inputs, outputs = {p.name for p in node.inputs}, {p.name for p in node.outputs}
    for each in connections:
        if node.name not in (each.source_node, each.destination_node):
            raise ValueError(f"{each} neither begins nor ends at node '{node.name}'")
        for end, port, known, side in (
            (each.source_node, each.source_output, outputs, "output"),
            (each.destination_node, each.destination_input, inputs, "input"),
        ):
            if end == node.name and port not in known:
                raise ValueError(f"{each}: node '{node.name}' has no {side} '{port}'")
    taken = {c.destination_input for c in connections if c.destination_node == node.name}
    given = {c.source_output for c in connections if c.source_node == node.name}
    added = [
        Connection(SENDER, port.name, node.name, port.name, 0)
        for port in node.inputs
        if port.name not in taken and port.external_topic is None
    ] + [
        Connection(node.name, port.name, RECEIVER, port.name, 0)
        for port in node.outputs
        if port.name not in given and port.external_topic is None
    ]
    return numbered([*connections, *added])


def with_observer(node: Node, connections: Sequence[Connection]) -> tuple[Connection, ...]:
    """Add a best-effort receiver, which never blocks, for each output without one."""
    seen = {
        c.source_output
        for c in connections
        if c.source_node == node.name and c.destination_node != node.name
    }
    added = [
        Connection(node.name, port.name, OBSERVER, port.name, queue_size=_MANY)
        for port in node.outputs
        if port.name not in seen and port.external_topic is None
    ]
    return numbered([*connections, *added])


def numbered(connections: Sequence[Connection]) -> tuple[Connection, ...]:
    """The same connections with their places in this sequence."""
    return tuple(replace(each, index=index) for index, each in enumerate(connections))
