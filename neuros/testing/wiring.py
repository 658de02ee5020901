"""The surroundings of a node under test: its ports, and the neighbours it is connected to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from neuros.project.message_types import normalised
from neuros.project.model import Connection, Node, Port

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
    """Ports from their names and message types, either notation."""
    found = []
    for name, written in types.items():
        type_name = normalised(written)
        if type_name is None:
            raise ValueError(
                f"'{name}': {written!r} is not a message type: write it like 'std_msgs/msg/String'"
            )
        found.append(Port(name, type_name))
    return tuple(found)


def _check_ends(node: Node, connections: Iterable[Connection]) -> None:
    """Raise ``ValueError`` for a connection that does not fit the node."""
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


def with_neighbours(node: Node, connections: Sequence[Connection]) -> tuple[Connection, ...]:
    """Add a lossless connection for each port that has none: from ``sender``, to ``receiver``.

    Raises ``ValueError`` for a given connection that does not fit the node.
    """
    _check_ends(node, connections)
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
    """Let outputs that no other node receives be seen, too, by one that never blocks them."""
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
