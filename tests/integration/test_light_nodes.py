"""What a node does not need is not imported for it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launching import launch

PLUGIN = """
import sys
from neuros.hooks import neuros_function, neuros_initialise

@neuros_initialise(outputs="out")
def begin(node):
    return node.make_packet("out")

@neuros_function(inputs="in", outputs="out")
def step(node, packet):
    node.get_logger().info("a line")
    found = [name for name in ("numpy", "yaml") if name in sys.modules]
    (node.run_dir / "modules").write_text(" ".join(found))
    return packet
"""


NUMPY = {
    "std_msgs/msg/String": "",
    "geometry_msgs/msg/Twist": "",
    "rosgraph_msgs/msg/Clock": "",
    "sensor_msgs/msg/Imu": "numpy",
    "std_msgs/msg/Float64MultiArray": "",
}


@pytest.mark.parametrize(
    ("backend", "types"),
    [
        # Nodes are forked from one process, which has imported the messages of all.
        ("process", [each for each, found in NUMPY.items() if not found]),
        ("process", ["sensor_msgs/msg/Imu"]),
        ("in-process", ["std_msgs/msg/Float64MultiArray"]),
        ("in-process", ["sensor_msgs/msg/Imu"]),
    ],
)
def test_a_node_has_numpy_only_for_arrays_and_no_yaml(
    tmp_path: Path, backend: str, types: list[str]
) -> None:
    (tmp_path / "a.py").write_text(PLUGIN)
    names = [f"node{number}" for number in range(len(types))]
    nodes = [
        {"name": name, "container": "neuros_python", "plugin": "a.py"}
        | {
            key: [{"name": port, "type": each}]
            for key, port in (("inputs", "in"), ("outputs", "out"))
        }
        for name, each in zip(names, types, strict=True)
    ]
    loops = [
        {"source_node": name, "source_output": "out", "discard_limit": 0}
        | {"destination_node": name, "destination_input": "in"}
        for name in names
    ]
    (tmp_path / "p.json").write_text(json.dumps({"nodes": nodes, "connections": loops}))
    options = ("--backend", backend, "--duration", "0.2")
    finished = launch(tmp_path / "p.json", *options, cwd=tmp_path)
    assert finished.exit_code == 0, finished.output
    assert finished.run_folder is not None
    for name, each in zip(names, types, strict=True):
        assert (finished.run_folder / name / "modules").read_text() == NUMPY[each], each
