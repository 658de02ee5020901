"""Chains, rings and fans: the same graph as a NeuROS project and as nodes without NeuROS.

NeuROS's connections are all lossless (``discard_limit`` 0, each packet acknowledged). The other
side has the same nodes and messages, one topic per output, reliable, depth 1: what is not taken in
time is overwritten. *One process* means in process here, and all nodes in one executor there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.bare_nodes import results
from benchmarks.launching import launch, project_of_plugins

STRING, EMPTY = "std_msgs/msg/String", "std_msgs/msg/Empty"
PACED = 50
RING_WARM_UP = 50

Node = dict[str, Any]


def chain(nodes: int, backend: str, seconds: float) -> dict[str, float]:
    """Packets per second at the end of a chain of at least 2, latency of paced ones (us)."""
    relays = [_relay(f"relay{i}") for i in range(1, nodes - 1)]
    graph = [_source("source", PACED), *relays, _sink("sink", seconds)]
    names = [node["name"] for node in graph]
    outputs = ["source.out", *(f"{relay['name']}.back" for relay in relays)]
    connections = [
        lossless(output, f"{name}.ball") for output, name in zip(outputs, names[1:], strict=True)
    ]
    return run(graph, [*connections, _again("source")], backend, ["sink"])[0]


def bare_chain(nodes: int, is_one_process: bool, seconds: float) -> dict[str, float]:
    """The same without NeuROS; ``delivered`` is the share that came through."""
    relays = [bare_relay(i, i - 1, i) for i in range(1, nodes - 1)]
    source = {"role": "source", "name": "source", "to": "t0", "paced": PACED}
    sink = {"role": "sink", "name": "sink", "from": f"t{nodes - 2}", "seconds": seconds}
    return _bare_received([source, *relays, sink], is_one_process, [nodes - 1])[0]


def ring(nodes: int, backend: str, laps: int) -> float:
    """Packets per second: one packet goes round a ring of at least 2."""
    ball: Node = {
        "name": "ball",
        "container": "neuros_python",
        "plugin": "ball.py",
        "inputs": [{"name": "back", "type": STRING}],
        "outputs": [{"name": "ball", "type": STRING}],
        "environment": {"LAPS": str(laps), "WARM_UP": str(RING_WARM_UP)},
    }
    graph = [ball, *(_relay(f"relay{i}") for i in range(1, nodes))]
    outputs = ["ball.ball", *(f"relay{i}.back" for i in range(1, nodes))]
    inputs = [*(f"relay{i}.ball" for i in range(1, nodes)), "ball.back"]
    connections = [lossless(*ends) for ends in zip(outputs, inputs, strict=True)]
    (lap_us,) = run(graph, connections, backend, ["ball"])
    return nodes * 1e6 / float(lap_us)


def bare_ring(nodes: int, is_one_process: bool, laps: int) -> float:
    """The same without NeuROS and without acknowledgements."""
    ball = {"role": "ball", "name": "ball", "from": f"t{nodes - 1}", "to": "t0"}
    ball |= {"laps": laps, "warm_up": RING_WARM_UP}
    graph = [ball, *(bare_relay(i, i - 1, i) for i in range(1, nodes))]
    (lap_us,) = results(_in_programs(graph, is_one_process), [0])
    return nodes * 1e6 / float(lap_us)


def one_to_many(receivers: int, backend: str, seconds: float) -> float:
    """Packets per second at all receivers together; each gets every packet."""
    names = [f"sink{i}" for i in range(receivers)]
    graph = [_source("source", 0), *(_sink(name, seconds) for name in names)]
    connections = [*(lossless("source.out", f"{name}.ball") for name in names), _again("source")]
    return sum(each["rate"] for each in run(graph, connections, backend, names))


def bare_one_to_many(receivers: int, is_one_process: bool, seconds: float) -> float:
    """The same without NeuROS: each gets what it can."""
    source = {"role": "source", "name": "source", "to": "t0", "paced": 0, "receivers": receivers}
    sinks = [
        {"role": "sink", "name": f"sink{i}", "from": "t0", "seconds": seconds}
        for i in range(receivers)
    ]
    numbers = range(1, receivers + 1)
    received = _bare_received([source, *sinks], is_one_process, numbers)
    return sum(each["rate"] for each in received)


def many_to_one(senders: int, backend: str, seconds: float) -> float:
    """Packets per second at the only receiver."""
    names = [f"source{i}" for i in range(senders)]
    graph = [*(_source(name, 0) for name in names), _sink("sink", seconds)]
    connections = [lossless(f"{name}.out", "sink.ball") for name in names]
    connections += [_again(name) for name in names]
    return run(graph, connections, backend, ["sink"])[0]["rate"]


def bare_many_to_one(senders: int, is_one_process: bool, seconds: float) -> float:
    """The same without NeuROS."""
    sources = [
        {"role": "source", "name": f"source{i}", "to": "t0", "paced": 0} for i in range(senders)
    ]
    sink = {"role": "sink", "name": "sink", "from": "t0", "senders": senders, "seconds": seconds}
    return _bare_received([*sources, sink], is_one_process, [senders])[0]["rate"]


def run(
    nodes: Sequence[Node],
    connections: Sequence[Mapping[str, Any]],
    backend: str,
    measuring: Sequence[str],
) -> list[Any]:
    """Run a project to its end; returns what these nodes have written to ``result.json``."""
    with project_of_plugins({"nodes": nodes, "connections": connections}) as folder:
        launch(folder, folder / "run", backend)
        files = [folder / "run" / name / "result.json" for name in measuring]
        return [json.loads(file.read_text()) for file in files]


def lossless(source: str, destination: str) -> dict[str, Any]:
    """A connection from ``node.output`` to ``node.input``."""
    (source_node, output), (destination_node, input_name) = (
        end.split(".") for end in (source, destination)
    )
    return {
        "source_node": source_node,
        "source_output": output,
        "destination_node": destination_node,
        "destination_input": input_name,
        "discard_limit": 0,
    }


def bare_relay(number: int, source: int, destination: int) -> Node:
    """A node without NeuROS from topic to topic."""
    ends = {"from": f"t{source}", "to": f"t{destination}"}
    return {"role": "relay", "name": f"relay{number}", **ends}


def _bare_received(
    nodes: Sequence[Node], is_one_process: bool, sinks: Sequence[int]
) -> list[dict[str, float]]:
    measuring = [0 for _ in sinks] if is_one_process else sinks
    return results(_in_programs(nodes, is_one_process), measuring)


def _in_programs(nodes: Sequence[Node], is_one_process: bool) -> list[Sequence[Node]]:
    return [nodes] if is_one_process else [[node] for node in nodes]


def _again(node: str) -> dict[str, Any]:
    return lossless(f"{node}.again", f"{node}.again")


def _relay(name: str) -> Node:
    return {
        "name": name,
        "container": "neuros_python",
        "plugin": "echo.py",
        "inputs": [{"name": "ball", "type": STRING}],
        "outputs": [{"name": "back", "type": STRING}],
    }


def _source(name: str, paced: int) -> Node:
    again = {"name": "again", "type": EMPTY}
    return {
        "name": name,
        "container": "neuros_python",
        "plugin": "source.py",
        "inputs": [again],
        "outputs": [{"name": "out", "type": STRING}, again],
        "environment": {"PACED": str(paced)},
    }


def _sink(name: str, seconds: float) -> Node:
    return {
        "name": name,
        "container": "neuros_python",
        "plugin": "sink.py",
        "inputs": [{"name": "ball", "type": STRING}],
        "environment": {"SECONDS": str(seconds)},
    }
