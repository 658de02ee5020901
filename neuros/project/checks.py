"""Checks that a schema cannot express: the parts of a project fit together.

All of it works on files that violate the schema elsewhere: what has the wrong form is passed over
here, as the schema has reported it, and what depends on it is not guessed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

from neuros.errors import Problem
from neuros.project.gazebo import remarks_on_gazebo
from neuros.project.message_types import normalised
from neuros.project.names import INTERNAL, MOST_CHARACTERS, Names
from neuros.project.parameters import parameter_mistakes
from neuros.project.parsed import ENDS, ParsedProject, names_of, rules_of
from neuros.project.scanner import Element
from neuros.project.suggest import did_you_mean

Side = Literal["inputs", "outputs"]
_LONGEST_PART = len("/data")


@dataclass
class _Ports:
    """The ports of one node by side and name; a side that could not be read is incomplete."""

    by_side: dict[Side, dict[str, Element]] = field(default_factory=dict)
    incomplete: set[Side] = field(default_factory=set)


def mistakes(parsed: ParsedProject) -> list[Problem]:
    """Everything that does not fit together."""
    return [
        *_duplicate_nodes(parsed),
        *_duplicate_ports(parsed),
        *_duplicate_connections(parsed),
        *_connection_ends(parsed),
        *_budget_mistakes(parsed),
        *_ros_graph_mistakes(parsed),
        *parameter_mistakes(parsed),
    ]


def remarks(parsed: ParsedProject) -> list[Problem]:
    """What is allowed, but may be a mistake. For a project without mistakes."""
    return sorted([*remarks_on_gazebo(parsed), *_unconnected(parsed), *_ros_graph_remarks(parsed)])


def _duplicate_nodes(parsed: ParsedProject) -> Iterator[Problem]:
    first: dict[str, tuple[Element, Element]] = {}
    for node, entry in zip(parsed.nodes, parsed.entries, strict=True):
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


def _duplicate_ports(parsed: ParsedProject) -> Iterator[Problem]:
    for node in parsed.nodes:
        for side in ("inputs", "outputs"):
            first: dict[str, Element] = {}
            for port in node.items(side):
                name = port.string("name")
                if name is not None and first.setdefault(name, port) is not port:
                    yield port.value["name"].problem(
                        f"two {side} of the node are named '{name}'", _where(first[name], "name")
                    )


def _duplicate_connections(parsed: ParsedProject) -> Iterator[Problem]:
    first: dict[tuple[str | None, ...], Element] = {}
    for connection in parsed.connections:
        ends = tuple(connection.string(end) for end in ENDS)
        if None not in ends and first.setdefault(ends, connection) is not connection:
            yield connection.problem(
                f"the connection {_named(ends)} occurs twice", _where(first[ends])
            )


def _connection_ends(parsed: ParsedProject) -> Iterator[Problem]:
    nodes = _ports_by_node(parsed)
    all_known = parsed.is_complete and all(node.string("name") for node in parsed.nodes)
    for connection in parsed.connections:
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


def _unconnected(parsed: ParsedProject) -> Iterator[Problem]:
    used = {
        (side, connection.string(node), connection.string(port))
        for connection in parsed.connections
        for side, node, port in (("outputs", *ENDS[:2]), ("inputs", *ENDS[2:]))
    }
    for node in parsed.nodes:
        for side in ("inputs", "outputs"):
            for port in node.items(side):
                key = (side, node.string("name"), port.string("name"))
                # A sensor may be read by the plugin alone, for a message of the user's own.
                is_sensor = side == "outputs" and port.member("mujoco") is not None
                if not (key in used or is_sensor or port.member("external_topic")):
                    yield port.problem(
                        f"{side[:-1]} '{key[2]}' of node '{key[1]}' is not connected"
                    )


def _ports_by_node(parsed: ParsedProject) -> dict[str, _Ports]:
    nodes: dict[str, _Ports] = {}
    for node in parsed.nodes:
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


# ---------------------------------------------------------------------- budgets


def _budget_mistakes(parsed: ParsedProject) -> Iterator[Problem]:
    """Budgets for connections that the project has not."""
    budgets = parsed.root.member("budgets")
    limits = None if budgets is None else budgets.member("lost_packets")
    if limits is None or not isinstance(limits.value, dict):
        return
    names = [_connection_name(connection) for connection in parsed.connections]
    known = [name for name in names if name is not None]
    for name, member in limits.value.items():
        if name not in known and len(known) == len(names):
            hint = did_you_mean(name, known) or "write 'a.out -> b.in', as `neuros launch` does"
            yield member.key_problem(f"there is no connection '{name}'", hint)


def _connection_name(connection: Element) -> str | None:
    """``a.out -> b.in``, ``None`` if an end is missing."""
    source, output, destination, input_ = (connection.string(end) for end in ENDS)
    if None in (source, output, destination, input_):
        return None
    return f"{source}.{output} -> {destination}.{input_}"


# ---------------------------------------------------------------------- ROS graph


def _ros_graph_mistakes(parsed: ParsedProject) -> Iterator[Problem]:
    """QoS where there is none to choose, rules for nothing, and names that are too long."""
    names = names_of(parsed)
    yield from _qos_of_connections(parsed)
    yield from _rules_without_sense(parsed, names)
    yield from _long_names(parsed, names)


def _ros_graph_remarks(parsed: ParsedProject) -> Iterator[Problem]:
    """QoS that does not do what it seems to."""
    for port, _, _ in _all_ports(parsed):
        qos = port.member("qos")
        if qos is None or qos.string("durability") != "transient_local":
            continue
        if qos.string("reliability") == "best_effort":
            yield qos.problem(
                "transient_local has no effect with best_effort: who comes later gets nothing",
                "make it reliable",
            )


def _qos_of_connections(parsed: ParsedProject) -> Iterator[Problem]:
    for port, side, _ in _all_ports(parsed):
        qos = port.member("qos")
        if qos is not None and port.member("external_topic") is None:
            yield qos.key_problem(
                f"'qos' is for external topics, and this {side[:-1]} has none",
                "the QoS of a connection follows from its discard_limit and queue_size",
            )


def _rules_without_sense(parsed: ParsedProject, names: Names) -> Iterator[Problem]:
    nodes = {node.string("name") or "": node for node in parsed.nodes}
    remap = parsed.root.member("remap")
    for rule in rules_of(remap):
        assert remap is not None
        only, _, old = rule.rpartition(":")
        if only and only not in nodes and parsed.is_complete:
            yield remap.value[rule].key_problem(
                f"there is no node '{only}'", did_you_mean(only, nodes)
            )
        if names.full(old, only).startswith(f"{names.namespace}{INTERNAL}"):
            yield remap.value[rule].key_problem(
                f"'{old}' is a topic of NeuROS's own, which keeps its name",
                "a namespace moves all of them",
            )


def _long_names(parsed: ParsedProject, names: Names) -> Iterator[Problem]:
    for port, _, node in _all_ports(parsed):
        topic = port.string("external_topic")
        if topic is not None:
            full = names.resolve(topic, node)
            if len(full) > MOST_CHARACTERS:
                yield port.value["external_topic"].problem(_too_long(full))
    for connection in parsed.connections:
        ends = [connection.string(end) or "" for end in ENDS]
        full = f"{names.namespace}{INTERNAL}{'/'.join(ends)}"
        if len(full) + _LONGEST_PART > MOST_CHARACTERS:
            yield connection.problem(
                _too_long(full), "choose shorter names, or a shorter namespace"
            )


def _too_long(topic: str) -> str:
    return f"the topic {topic} is longer than the {MOST_CHARACTERS} characters that ROS allows"


def _all_ports(parsed: ParsedProject) -> Iterator[tuple[Element, str, str]]:
    """Every port with its side and the name of its node."""
    for node in parsed.nodes:
        for side in ("inputs", "outputs"):
            for port in node.items(side):
                yield port, side, node.string("name") or ""
