"""The local runtime for tests of plugins: a clock that stands still, and a node without ROS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from neuros.errors import NodeError
from neuros.ports import Inbox, Logger
from neuros.project.message_types import in_full, normalised, with_copies, wrong_array
from neuros.project.model import Connection, Node, NodeFile, Port, Value
from neuros.runtime.local import (
    LocalLoop,
    LocalMiddleware,
    LocalRosNode,
    Record,
    log_in_python,
)
from neuros.transport.messages import copy_packet

_NOTHING: Mapping[str, Value] = MappingProxyType({})


class ManualClock:
    """A monotonic clock in nanoseconds; it starts at 0."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns


class StepLoop(LocalLoop):
    """The loop of the runtime, with a clock that a test advances."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__(clock)
        self._manual = clock

    def advance_to(self, time_ns: int) -> None:
        """Advance the clock, and call the timers that are due."""
        self._manual.now_ns = time_ns
        self.run_due_timers()


class RosNodeStandIn(LocalRosNode):
    """The result of ``node.get_ros_node()`` in a test: name, logger and parameters, without ROS.

    Args:
        topics: by name of the node's topics: type, number of publishers, number of subscribers.
    """

    def __init__(
        self,
        name: str,
        logger: Logger,
        parameters: Mapping[str, Value] = _NOTHING,
        topics: Mapping[str, tuple[str, int, int]] = MappingProxyType({}),
    ) -> None:
        super().__init__(name, logger, parameters, _refuse)
        self._topics = topics

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        """The topics of the node's own ports."""
        return [(name, [topic[0]]) for name, topic in sorted(self._topics.items())]

    def count_publishers(self, name: str) -> int:
        """The number of publishers: the node, or the test."""
        return self._topics[name][1]

    def count_subscribers(self, name: str) -> int:
        return self._topics[name][2]


def _refuse(attribute: str) -> Any:
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
        if self.inbox is not None:
            self.inbox.on_external_packet(port, packet)

    def send_external(self, port: Port, packet: Any) -> None:
        self.published.setdefault(port.name, []).append(copy_packet(packet))

    def show(self, connections: Sequence[Connection], packet: Any) -> None:
        """The test has no ROS tools that subscribe."""

    def close(self) -> None:
        """Drop further packets."""
        self.inbox = None


class Workbench(LocalMiddleware):
    """The middleware of one node under test (:class:`neuros.ports.Middleware`)."""

    def __init__(self, loop: StepLoop, topics: Topics, log: list[Record]) -> None:
        def write(name: str, record: Record) -> None:
            log.append(record)
            log_in_python(name, record)

        super().__init__(loop, write, _raise)
        self._topics = topics

    def local_ros_node(self, file: NodeFile, logger: Logger) -> LocalRosNode:
        node = file.node
        return RosNodeStandIn(node.name, logger, node.parameters, _topics_of(file))

    def bridge(self, file: NodeFile) -> Topics:
        return self._topics


def _raise(error: BaseException) -> None:
    raise error


def _topics_of(file: NodeFile) -> dict[str, tuple[str, int, int]]:
    """The topics of a node's ports, as on the ROS graph."""
    node = file.node
    found = {}
    for c in file.connections:
        is_output = c.source_node == node.name
        port = node.output(c.source_output) if is_output else node.input(c.destination_input)
        found[f"{c.topic}/data"] = (port.ros_type, 1, 1)
    for is_output, ports in ((True, node.outputs), (False, node.inputs)):
        for port in ports:
            if port.external_topic is not None:
                name = file.names.resolve(port.external_topic, node.name)
                found[name] = (port.ros_type, int(is_output), int(not is_output))
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


def ports(types: Mapping[str, str], copies: int | None = None) -> tuple[Port, ...]:
    """Ports from their names and message types, in either notation."""
    found = []
    for name, written in types.items():
        type_name = normalised(in_full(written))
        if type_name is None:
            text, hint = wrong_array(written) or (
                f"{written!r} is not a message type",
                "write it like 'std_msgs/msg/String'",
            )
            raise ValueError(f"'{name}': {text}{hint and f': {hint}'}")
        found.append(Port(name, with_copies(type_name, copies)))
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
