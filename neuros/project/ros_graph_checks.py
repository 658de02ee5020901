"""ROS graph checks of a project: names, remapping rules and QoS of its topics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from neuros.errors import Problem
from neuros.project.draft import Draft
from neuros.project.names import INTERNAL, MOST_CHARACTERS, Names, normalised_namespace
from neuros.project.source import Element
from neuros.project.suggest import did_you_mean

_ENDS = ("source_node", "source_output", "destination_node", "destination_input")
_LONGEST_PART = len("/data")
_SIDES = ("inputs", "outputs")


def names_of(draft: Draft) -> Names:
    """The namespace and rules of a project; what has the wrong form is passed over."""
    namespace = draft.root.string("namespace") or ""
    return names_from(namespace, _rules(draft.root.member("remap")))


def names_from(namespace: str, remap: Mapping[str, str]) -> Names:
    """The same from valid values."""
    return Names(normalised_namespace(namespace), tuple(remap.items()))


def names_to_json(names: Names) -> dict[str, Any]:
    """As a project file has them; only what there is."""
    content: dict[str, Any] = {"namespace": names.namespace, "remap": dict(names.remap)}
    return {key: value for key, value in content.items() if value}


def ros_graph_mistakes(draft: Draft) -> Iterator[Problem]:
    """QoS where there is none to choose, rules for nothing, and names that are too long."""
    names = names_of(draft)
    yield from _qos_of_connections(draft)
    yield from _rules_without_sense(draft, names)
    yield from _long_names(draft, names)


def ros_graph_remarks(draft: Draft) -> Iterator[Problem]:
    """QoS that does not do what it seems to."""
    for port, _, _ in _ports(draft):
        qos = port.member("qos")
        if qos is None or qos.string("durability") != "transient_local":
            continue
        if qos.string("reliability") == "best_effort":
            yield qos.problem(
                "transient_local has no effect with best_effort: who comes later gets nothing",
                "make it reliable",
            )


def _qos_of_connections(draft: Draft) -> Iterator[Problem]:
    for port, side, _ in _ports(draft):
        qos = port.member("qos")
        if qos is not None and port.member("external_topic") is None:
            yield qos.key_problem(
                f"'qos' is for external topics, and this {side[:-1]} has none",
                "the QoS of a connection follows from its discard_limit and queue_size",
            )


def _rules_without_sense(draft: Draft, names: Names) -> Iterator[Problem]:
    nodes = {node.string("name") or "": node for node in draft.nodes}
    remap = draft.root.member("remap")
    for rule in _rules(remap):
        assert remap is not None
        only, _, old = rule.rpartition(":")
        if only and only not in nodes and draft.is_complete:
            yield remap.value[rule].key_problem(
                f"there is no node '{only}'", did_you_mean(only, nodes)
            )
        if names.full(old, only).startswith(f"{names.namespace}{INTERNAL}"):
            yield remap.value[rule].key_problem(
                f"'{old}' is a topic of NeuROS's own, which keeps its name",
                "a namespace moves all of them",
            )


def _long_names(draft: Draft, names: Names) -> Iterator[Problem]:
    for port, _, node in _ports(draft):
        topic = port.string("external_topic")
        if topic is not None:
            full = names.resolve(topic, node)
            if len(full) > MOST_CHARACTERS:
                yield port.value["external_topic"].problem(_too_long(full))
    for connection in draft.connections:
        ends = [connection.string(end) or "" for end in _ENDS]
        full = f"{names.namespace}{INTERNAL}{'/'.join(ends)}"
        if len(full) + _LONGEST_PART > MOST_CHARACTERS:
            yield connection.problem(
                _too_long(full), "choose shorter names, or a shorter namespace"
            )


def _too_long(topic: str) -> str:
    return f"the topic {topic} is longer than the {MOST_CHARACTERS} characters that ROS allows"


def _rules(remap: Element | None) -> dict[str, str]:
    if remap is None or not isinstance(remap.value, dict):
        return {}
    return {old: new.value for old, new in remap.value.items() if isinstance(new.value, str)}


def _ports(draft: Draft) -> Iterator[tuple[Element, str, str]]:
    """Every port with its side and the name of its node."""
    for node in draft.nodes:
        for side in _SIDES:
            for port in node.items(side):
                yield port, side, node.string("name") or ""
