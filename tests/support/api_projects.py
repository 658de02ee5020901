"""A project for the tests of Python's way to run projects: dice that are thrown and summed up."""

from __future__ import annotations

import json
from pathlib import Path

THROWER = """
import os, random
from neuros.hooks import neuros_initialise, neuros_function

@neuros_initialise()
def start(node):
    node.set_user_data(random.Random(int(os.environ["SEED"])))

@neuros_function(outputs="eyes")
def throw(node):
    packet = node.make_packet("eyes")
    packet.data = node.get_user_data().randint(1, int(os.environ["FACES"]))
    return packet
"""
COUNTER = """
from neuros.hooks import neuros_function

@neuros_function(inputs="eyes")
def add(node, eyes):
    seen = node.get_user_data() or []
    seen.append(eyes.data)
    node.set_user_data(seen)
    if eyes.data == 13:
        raise RuntimeError("thirteen eyes")
    if len(seen) == 1:
        node.get_logger().info("counting")
    if len(seen) == 10:
        node.set_result("sum", sum(seen))
        node.set_result("eyes", seen)
        node.shutdown("ten were thrown")
"""
ENDLESS = COUNTER.replace("== 10", "== 0")


def dice(folder: Path, counter: str = COUNTER) -> Path:
    """Write the project ``dice``; returns its folder."""
    made = folder / "dice"
    made.mkdir()
    (made / "thrower.py").write_text(THROWER)
    (made / "counter.py").write_text(counter)
    eyes = {"name": "eyes", "type": "std_msgs/msg/Int32"}
    nodes = [
        {"name": "thrower", "plugin": "thrower.py", "outputs": [eyes]},
        {"name": "counter", "plugin": "counter.py", "inputs": [eyes]},
    ]
    nodes = [{**node, "container": "neuros_python"} for node in nodes]
    nodes[0]["environment"] = {"SEED": "1", "FACES": "6"}
    connection = {
        "source_node": "thrower",
        "source_output": "eyes",
        "destination_node": "counter",
        "destination_input": "eyes",
        "discard_limit": 0,
    }
    project = {"nodes": nodes, "connections": [connection]}
    (made / "project.json").write_text(json.dumps(project))
    return made
