"""What keeps a project from doing the same again, as far as its files and plugins tell."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import neuros
from neuros.project.load import load_project
from neuros.project.repeatable import why_not_repeatable

TYPE = "std_msgs/msg/Int32"
HOOKS = "from neuros.hooks import All, Optional, neuros_function, neuros_tick\n\n"
SOURCE = HOOKS + "@neuros_function(outputs='x')\ndef send(node):\n    return 0\n"
MIDDLE = HOOKS + "@neuros_function(inputs='x', outputs='y')\ndef pass_on(node, x):\n    return x\n"
SINK = HOOKS + "@neuros_function(inputs=Optional('y'))\ndef show(node, y):\n    pass\n"


def why(folder: Path, *, middle: str = MIDDLE, is_stepped: bool = False, **keys: Any) -> list[str]:
    """Of a source, a node between, and a plot, whose connection may lose packets."""
    plugins = {"source": SOURCE, "middle": middle, "sink": SINK}
    ports = {"source": ([], ["x"]), "middle": (["x"], ["y"]), "sink": (["y"], [])}
    nodes = []
    for name, (inputs, outputs) in ports.items():
        (folder / f"{name}.py").write_text(plugins[name])
        node: dict[str, Any] = {"name": name, "container": "neuros_python", "plugin": f"{name}.py"}
        node["inputs"] = [{"name": each, "type": TYPE} for each in inputs]
        node["outputs"] = [{"name": each, "type": TYPE} for each in outputs]
        nodes.append(node)
    nodes[1]["inputs"][0] |= keys.get("port", {})
    given = keys.get("wires", ["source.x -> middle.x"])
    wires = [*given, "middle.y -> sink.y"]
    connections = []
    for wire in wires:
        ends = [end.split(".") for end in wire.split(" -> ")]
        names = ("source_node", "source_output", "destination_node", "destination_input")
        connections.append(dict(zip(names, [*ends[0], *ends[1]], strict=True)))
    if "limit" in keys:
        for connection in connections[:-1]:
            connection["discard_limit"] = keys["limit"]
    (folder / "project.json").write_text(json.dumps({"nodes": nodes, "connections": connections}))
    loaded = load_project(folder, workspace=Path(neuros.__file__).parent / "workspace")
    return why_not_repeatable(loaded.project, is_stepped=is_stepped)


def test_lossless_connections_to_all_but_plots_are_enough(tmp_path: Path) -> None:
    assert why(tmp_path, limit=0) == []


@pytest.mark.parametrize("limit", [None, 3])
def test_a_connection_that_may_lose_packets(tmp_path: Path, limit: int | None) -> None:
    keys = {} if limit is None else {"limit": limit}
    assert why(tmp_path, **keys) == [
        'source.x -> middle.x: may lose packets: give it "discard_limit": 0'
    ]


def test_a_tick_by_the_wall_clock(tmp_path: Path) -> None:
    ticks = MIDDLE + "\n@neuros_tick(0.1)\ndef look(node):\n    pass\n"
    (found,) = why(tmp_path, middle=ticks, limit=0)
    assert found.startswith("middle, hook 'look': ticks by the wall clock: ")


def test_an_optional_input(tmp_path: Path) -> None:
    (found,) = why(tmp_path, middle=MIDDLE.replace("inputs='x'", "inputs=Optional('x')"), limit=0)
    assert found.startswith("middle, hook 'pass_on': input 'x' is Optional, ")


def test_an_input_with_several_sources_that_does_not_take_all(tmp_path: Path) -> None:
    wires = ["source.x -> middle.x", "middle.y -> middle.x"]
    (found,) = why(tmp_path, wires=wires, limit=0)
    assert found.startswith("middle, hook 'pass_on': input 'x' has 2 sources, ")
    takes_all = MIDDLE.replace("inputs='x'", "inputs=All('x')")
    assert why(tmp_path, middle=takes_all, wires=wires, limit=0) == []


def test_an_external_topic(tmp_path: Path) -> None:
    found = why(tmp_path, port={"external_topic": "/joy"}, wires=[], limit=0)
    assert found == ["middle.x: other programs send on /joy"]


@pytest.mark.parametrize("call", ["sim.run_asynchronous()", "node.submit({}, bool)"])
def test_a_thread_that_sends_even_where_a_program_steps_all(tmp_path: Path, call: str) -> None:
    sends = MIDDLE + f"\ndef begin(node, sim):\n    {call}\n"
    (found,) = why(tmp_path, middle=sends, is_stepped=True)
    assert found.startswith("middle: its plugin sends from a thread ")


def test_where_a_program_steps_all_nodes_losses_and_ticks_are_repeated(tmp_path: Path) -> None:
    ticks = MIDDLE + "\n@neuros_tick(0.1)\ndef look(node):\n    pass\n"
    assert why(tmp_path, middle=ticks, is_stepped=True) == []
