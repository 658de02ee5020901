"""Which hooks start once more at most when a project drains: those without which it never would."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from engine_bench import function, initialise, tick, wire
from engine_network import Network
from hypothesis import given, settings
from hypothesis import strategies as st
from test_engine_projects import delays, projects, slow_and_fast, strict_plugin, strict_projects

from neuros.hooks import All, HookSpec, Optional
from neuros.launcher.quiescence import Declarations
from neuros.node.reports import declared
from neuros.project.model import Connection, Folders, Node, NodeFile, Port

Plugins = Mapping[str, Sequence[HookSpec]]
NOWHERE = Folders(Path(), Path(), Path())


def last_round(
    plugins: Plugins,
    connections: Sequence[Connection],
    stopped: str = "",
    external: Sequence[tuple[str, str]] = (),
) -> dict[str, list[str]]:
    """The names of the hooks, by node."""
    files = [
        NodeFile(
            Node(
                name,
                "",
                Path("plugin.py"),
                inputs=tuple(Port(port, "", "/topic") for node, port in external if node == name),
            ),
            tuple(c for c in connections if name in (c.source_node, c.destination_node)),
            NOWHERE,
        )
        for name in plugins
    ]
    declarations = Declarations(files)
    for name, specs in plugins.items():
        declarations.add(declared(name, specs))
    found = declarations.last_round(stopped)
    return {name: [plugins[name][place].name for place in places] for name, places in found.items()}


# ------------------------------------------------------------------ by example

AB, BA = wire("a.o -> b.x", 0), wire("b.o -> a.x", 0, index=1)
LOCKSTEP: Plugins = {
    "a": [initialise("begin", outputs="o"), function("step", "x", "o")],
    "b": [function("answer", "x", "o")],
}


def test_a_lockstep_loop_goes_round_once_more() -> None:
    assert last_round(LOCKSTEP, [AB, BA]) == {"a": ["step"], "b": ["answer"]}


def test_but_not_if_one_of_its_nodes_has_stopped() -> None:
    assert last_round(LOCKSTEP, [AB, BA], stopped="b") == {}


@pytest.mark.parametrize(("limit", "ends"), [(0, True), (3, True), (None, False)])
def test_nor_if_it_sends_reliably_to_a_node_that_has_stopped(limit: int | None, ends: bool) -> None:
    connections = [AB, BA, wire("a.o -> c.x", limit, index=2)]
    plugins = {**LOCKSTEP, "c": [function("count", "x")]}
    assert (last_round(plugins, connections, stopped="c") == {}) is ends
    assert last_round(plugins, connections) == {"a": ["step"], "b": ["answer"]}, "c works it off"


def test_nor_if_a_node_that_is_not_known_has_to_take_what_it_sends() -> None:
    elsewhere = wire("a.o -> elsewhere.x", 0, index=2)
    assert last_round(LOCKSTEP, [AB, BA, elsewhere]) == {}


def test_nor_if_a_tick_hook_is_part_of_it_or_has_to_take_what_it_sends() -> None:
    ticks: Plugins = {**LOCKSTEP, "b": [tick("answer", 1.0, "x", "o")]}
    assert last_round(ticks, [AB, BA]) == {}
    plugins = {**LOCKSTEP, "c": [tick("show", 1.0, Optional("x"))]}
    assert last_round(plugins, [AB, BA, wire("a.o -> c.x", 0, index=2)]) == {}


def test_nor_if_what_returns_is_optional_since_that_stops_anyway() -> None:
    free: Plugins = {**LOCKSTEP, "a": [function("step", Optional("x"), "o")]}
    assert last_round(free, [AB, BA]) == {}


def test_of_several_sources_one_in_the_loop_is_enough_but_not_for_all() -> None:
    connections = [AB, BA, wire("c.o -> b.x", 0, index=2)]
    ticking = tick("tick", 1.0, outputs="o")
    joins: Plugins = {**LOCKSTEP, "c": [ticking], "b": [function("answer", All("x"), "o")]}
    assert last_round({**LOCKSTEP, "c": [ticking]}, connections) == {
        "a": ["step"],
        "b": ["answer"],
    }
    assert last_round(joins, connections) == {}


def test_a_node_may_be_a_loop_of_its_own() -> None:
    own = wire("a.o -> a.x", 0)
    assert last_round({"a": [function("step", "x", "o")]}, [own]) == {"a": ["step"]}


def test_what_an_external_topic_brings_is_passed_on_once_more() -> None:
    plugins = {"a": [function("pass_on", "x", "o"), function("look", "x")], "b": LOCKSTEP["b"]}
    assert last_round(plugins, [AB], external=[("a", "x")]) == {"a": ["pass_on"]}


# ------------------------------------------------------------------ random projects


def network_of(
    connections: Sequence[Connection], plugins: Plugins, delays_ns: Sequence[int], before: int
) -> Network:
    network = Network(connections, plugins, delays_ns)
    network.run(before)
    return network


def drain(network: Network, plugins: Plugins, stopped: str) -> None:
    names = last_round(plugins, network.connections, stopped)
    for name, node in network.nodes.items():
        hooks = [hook.name for hook in node.engine.all_hooks]
        node.engine.drain([hooks.index(each) for each in names.get(name, ())])


def sent(network: Network) -> list[int]:
    return [len(network.sequences[c]) for c in network.connections]


@settings(max_examples=150, deadline=None)
@given(data=st.data(), delays_ns=delays | slow_and_fast, before=st.integers(0, 200))
def test_every_project_that_sends_what_it_may_comes_to_its_end(
    data: Any, delays_ns: list[int], before: int
) -> None:
    connections, plugins = data.draw(projects(gaps=(0,)))
    stopped = data.draw(st.sampled_from(["", *plugins]))
    network = network_of(connections, plugins, delays_ns, before)
    if stopped:
        network.nodes[stopped].engine.stop_hooks()
    drain(network, plugins, stopped)
    network.run(2000)
    at_rest = sent(network)
    network.run(300)
    assert sent(network) == at_rest
    assert not any(node.engine.has_startable_packet for node in network.nodes.values())
    for c in connections:
        subscription = network.receiver(c)
        assert network.sender(c).sent == subscription.received
        assert (
            subscription.received
            == subscription.consumed + subscription.discarded + subscription.unread
        )


@settings(max_examples=100, deadline=None)
@given(
    project=strict_projects(),
    delays_ns=delays | slow_and_fast,
    before=st.integers(0, 200),
    data=st.data(),
)
def test_what_comes_to_its_end_by_itself_does_so_as_ever(
    project: Any, delays_ns: list[int], before: int, data: Any
) -> None:
    connections, plan = project
    stopped = data.draw(st.sampled_from([*plan]))
    sequences = []
    for is_told in (False, True):
        plugins = {name: strict_plugin(*each) for name, each in plan.items()}
        network = network_of(connections, plugins, delays_ns, before)
        network.nodes[stopped].engine.stop_hooks()
        if is_told:
            drain(network, plugins, stopped)
        else:
            for node in network.nodes.values():
                node.engine.drain()
        if not network.run(1500):
            return  # it goes on for ever
        sequences.append(network.sequences)
    assert sequences[0] == sequences[1]
