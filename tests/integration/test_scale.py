"""Many nodes in one project: every connection of each is proved by a packet."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from launching import launch

TYPE = "std_msgs/msg/Int32"
CHORD = 7  # how far the second connection of each node reaches

PLUGIN = '''\
"""Passes a token round the ring; whoever has it also sends it along a chord."""

from neuros.hooks import Optional, neuros_function, neuros_initialise

FIRST = "node0"


@neuros_initialise(outputs=Optional("token"))
def begin(node):
    return node.make_packet("token") if node.name == FIRST else None


@neuros_function(inputs="ring", outputs=Optional("token"))
def pass_on(node, token):
    if node.name != FIRST:
        return token
    node.shutdown("the token has been everywhere")


@neuros_function(inputs="chord")
def look(node, token):
    pass
'''


def ring(folder: Path, count: int) -> Path:
    """Write a project of ``count`` nodes, each of which sends to its neighbour and one other."""
    folder.mkdir()
    (folder / "member.py").write_text(PLUGIN)
    node = {
        "container": "neuros_python",
        "plugin": "member.py",
        "inputs": [{"name": name, "type": TYPE} for name in ("ring", "chord")],
        "outputs": [{"name": "token", "type": TYPE}],
    }
    project = {
        "nodes": [{"name": f"node{i}", **node} for i in range(count)],
        "connections": [
            {
                "source_node": f"node{i}",
                "source_output": "token",
                "destination_node": f"node{(i + step) % count}",
                "destination_input": name,
                "discard_limit": 0,
            }
            for i in range(count)
            for name, step in (("ring", 1), ("chord", CHORD))
        ],
    }
    (folder / "project.json").write_text(json.dumps(project))
    return folder


def the_packets_of(count: int, back_end: str, folder: Path, timeout_s: float) -> Iterator[int]:
    """How many packets each connection of a ring has carried, once it has been run."""
    project = ring(folder / "project", count)
    finished = launch(project, "--backend", back_end, cwd=folder, timeout_s=timeout_s)
    assert finished.exit_code == 0, finished.output
    assert "the token has been everywhere" in finished.output
    connections = finished.record["connections"]
    assert len(connections) == 2 * count
    for connection in connections:
        assert connection["sent"] == connection["received"], connection
        yield connection["received"]


@pytest.mark.parametrize(("back_end", "count"), [("process", 20), ("in-process", 64)])
def test_a_packet_goes_over_every_connection(back_end: str, count: int, tmp_path: Path) -> None:
    assert set(the_packets_of(count, back_end, tmp_path, 120.0)) == {1}


@pytest.mark.acceptance
def test_a_packet_goes_over_every_connection_of_64_processes(tmp_path: Path) -> None:
    assert set(the_packets_of(64, "process", tmp_path, 180.0)) == {1}
