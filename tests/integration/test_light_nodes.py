"""What a node does not need is not imported for it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launching import BACKENDS, launch

PLUGIN = """
import sys
from neuros.hooks import neuros_function, neuros_initialise

@neuros_initialise(outputs="out")
def begin(node):
    return node.make_packet("out")

@neuros_function(inputs="in", outputs="out")
def step(node, packet):
    node.get_logger().info("a line")
    node.shutdown("enough")
    found = [name for name in ("numpy", "yaml") if name in sys.modules]
    (node.run_dir / "modules").write_text(" ".join(found))
    return packet
"""


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("type_name", "modules"),
    [
        ("std_msgs/msg/String", ""),
        ("geometry_msgs/msg/Twist", ""),
        ("rosgraph_msgs/msg/Clock", ""),
        ("sensor_msgs/msg/Imu", "numpy"),
        ("std_msgs/msg/Float64MultiArray", ""),
    ],
)
def test_a_node_has_numpy_only_for_arrays_and_no_yaml(
    tmp_path: Path, backend: str, type_name: str, modules: str
) -> None:
    (tmp_path / "a.py").write_text(PLUGIN)
    port = {"type": type_name}
    node = {"name": "a", "container": "neuros_python", "plugin": "a.py"}
    node |= {"inputs": [{"name": "in", **port}], "outputs": [{"name": "out", **port}]}
    loop = {"source_node": "a", "source_output": "out", "discard_limit": 0}
    loop |= {"destination_node": "a", "destination_input": "in"}
    (tmp_path / "p.json").write_text(json.dumps({"nodes": [node], "connections": [loop]}))
    finished = launch(tmp_path / "p.json", "--backend", backend, cwd=tmp_path)
    assert finished.exit_code == 0, finished.output
    assert finished.run_folder is not None
    assert (finished.run_folder / "a" / "modules").read_text() == modules
