"""What a schema cannot express: whether the parts of a project fit together.

All of it works on files that violate the schema elsewhere: what has the wrong form is passed over
here, as the schema has reported it, and what depends on it is not guessed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

from neuros.errors import Problem
from neuros.project.budgets import budget_mistakes
from neuros.project.draft import Draft
from neuros.project.gazebo import remarks_on_gazebo
from neuros.project.message_types import normalised
from neuros.project.parameters import parameter_mistakes
from neuros.project.ros_graph_checks import ros_graph_mistakes, ros_graph_remarks
from neuros.project.source import Element
from neuros.project.suggest import did_you_mean

Side = Literal["inputs", "outputs"]
_ENDS = ("source_node", "source_output", "destination_node", "destination_input")


@dataclass
class _Ports:
    """The ports of one node by side and name; a side that could not be read is incomplete."""

    by_side: dict[Side, dict[str, Element]] = field(default_factory=dict)
    incomplete: set[Side] = field(default_factory=set)


def mistakes(draft: Draft) -> list[Problem]:
    """Everything that does not fit together."""
    return [
        *_duplicate_nodes(draft),
        *_duplicate_ports(draft),
        *_duplicate_connections(draft),
        *_connection_ends(draft),
        *budget_mistakes(draft),
        *ros_graph_mistakes(draft),
        *parameter_mistakes(draft),
    ]


def remarks(draft: Draft) -> list[Problem]:
    """What is allowed, but may be a mistake. For a project without mistakes."""
    return sorted([*remarks_on_gazebo(draft), *_unconnected(draft), *ros_graph_remarks(draft)])


def _duplicate_nodes(draft: Draft) -> Iterator[Problem]:
    first: dict[str, tuple[Element, Element]] = {}
    for node, entry in zip(draft.nodes, draft.entries, strict=True):
        name = node.string("name")
        if name is None:
            continue
        other, other_entry = first.setdefault(name.lower(), (node, entry))
        if other is node:
            continue
        if other.source.file == node.source.file and other.pointer == node.pointer:
            # One node file, used twice: the places of the names are the same.
            yield entry.problem(f"the node name '{name}' occurs twice", _where(other_entry))
            continue
        text = f"the node name '{name}' occurs twice"
        if other.string("name") != name:
            text = f"the node names '{other.string('name')}' and '{name}' differ only in case"
        yield node.value["name"].problem(text, _where(other, "name"))


def _duplicate_ports(draft: Draft) -> Iterator[Problem]:
    for node in draft.nodes:
        for side in ("inputs", "outputs"):
            first: dict[str, Element] = {}
            for port in node.items(side):
                name = port.string("name")
                if name is not None and first.setdefault(name, port) is not port:
                    yield port.value["name"].problem(
                        f"two {side} of the node are named '{name}'", _where(first[name], "name")
                    )


def _duplicate_connections(draft: Draft) -> Iterator[Problem]:
    first: dict[tuple[str | None, ...], Element] = {}
    for connection in draft.connections:
        ends = tuple(connection.string(end) for end in _ENDS)
        if None not in ends and first.setdefault(ends, connection) is not connection:
            yield connection.problem(
                f"the connection {_named(ends)} occurs twice", _where(first[ends])
            )


def _connection_ends(draft: Draft) -> Iterator[Problem]:
    nodes = _ports_by_node(draft)
    all_known = draft.is_complete and all(node.string("name") for node in draft.nodes)
    for connection in draft.connections:
        found: list[Element] = []
        sides: tuple[tuple[str, str, Side], ...] = (
            ("source_node", "source_output", "outputs"),
            ("destination_node", "destination_input", "inputs"),
        )
        for node_key, port_key, side in sides:
            node, port = connection.string(node_key), connection.string(port_key)
            if node is None:
                continue
            if node not in nodes:
                if all_known and node:
                    hint = did_you_mean(node, nodes)
                    yield connection.value[node_key].problem(f"there is no node '{node}'", hint)
                continue
            result = _port(nodes[node], node, port, side) if port else None
            if isinstance(result, Element):
                found.append(result)
                if result.member("external_topic") is not None:
                    yield connection.value[port_key].problem(
                        f"{side[:-1]} '{port}' of node '{node}' has an external topic, so it "
                        "cannot be connected",
                        _where(result, "external_topic"),
                    )
            elif result is not None:
                yield connection.value[port_key].problem(*result)
        yield from _different_types(connection, found)


def _port(ports: _Ports, node: str, port: str, side: Side) -> Element | tuple[str, str] | None:
    """The port, or what is wrong with it, or ``None`` if that cannot be known."""
    if port in ports.by_side[side]:
        return ports.by_side[side][port]
    if side in ports.incomplete:
        return None
    other: Side = "outputs" if side == "inputs" else "inputs"
    hint = did_you_mean(port, ports.by_side[side])
    if port in ports.by_side[other]:
        hint = f"it has an {other[:-1]} of that name"
    return f"node '{node}' has no {side[:-1]} '{port}'", hint


def _different_types(connection: Element, ends: list[Element]) -> Iterator[Problem]:
    types = [normalised(port.string("type") or "") for port in ends]
    if len(types) == 2 and None not in types and types[0] != types[1]:
        source, destination = ends
        yield connection.problem(
            f"the output sends {types[0]}, the input takes {types[1]}",
            f"{_where(source, 'type')} and {_where(destination, 'type').removeprefix('see ')}",
        )


def _unconnected(draft: Draft) -> Iterator[Problem]:
    used = {
        (side, connection.string(node), connection.string(port))
        for connection in draft.connections
        for side, node, port in (("outputs", *_ENDS[:2]), ("inputs", *_ENDS[2:]))
    }
    for node in draft.nodes:
        for side in ("inputs", "outputs"):
            for port in node.items(side):
                key = (side, node.string("name"), port.string("name"))
                # A sensor may be read by the plugin alone, for a message of the user's own.
                is_sensor = side == "outputs" and port.member("mujoco") is not None
                if not (key in used or is_sensor or port.member("external_topic")):
                    yield port.problem(
                        f"{side[:-1]} '{key[2]}' of node '{key[1]}' is not connected"
                    )


def _ports_by_node(draft: Draft) -> dict[str, _Ports]:
    nodes: dict[str, _Ports] = {}
    for node in draft.nodes:
        ports = nodes.setdefault(node.string("name") or "", _Ports())
        sides: tuple[Side, ...] = ("inputs", "outputs")
        for side in sides:
            named = ports.by_side.setdefault(side, {})
            items = node.items(side)
            for port in items:
                named.setdefault(port.string("name") or "", port)
            member = node.member(side)
            is_list = member is None or isinstance(member.value, list)
            if not is_list or any(port.string("name") is None for port in items):
                ports.incomplete.add(side)
    return nodes


def _named(ends: tuple[str | None, ...]) -> str:
    return f"{ends[0]}.{ends[1]} -> {ends[2]}.{ends[3]}"


def _where(element: Element, key: str = "") -> str:
    """Where the other one is, for a hint."""
    place = element.value[key] if key else element
    line, column = place.source.place(place.start)
    return f"see {place.source.name}:{line}:{column}"
