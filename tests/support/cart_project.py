"""A project with simulated time: a robot on a line, and a brain that brings it back to 0."""

from __future__ import annotations

import json
from pathlib import Path

ROBOT = """
from neuros.hooks import neuros_function, Optional

@neuros_function(inputs=Optional("push"), outputs=["pose", "clock"])
def step(node, push):
    place, steps = node.get_user_data() or (1.0, 0)
    if push is not None:
        place += push.data
    steps += 1
    node.set_user_data((place, steps))
    pose, clock = node.make_packet("pose"), node.make_packet("clock")
    pose.data = place
    clock.clock.sec, clock.clock.nanosec = divmod(steps * 10_000_000, 10**9)
    return pose, clock

@neuros_function(inputs="wheels")
def steer(node, wheels):
    if wheels.data == 13.0:
        raise RuntimeError("a wheel has broken")
    place, steps = node.get_user_data() or (1.0, 0)
    node.set_user_data((place + wheels.data, steps))
"""
BRAIN = """
from neuros.hooks import neuros_function

@neuros_function(inputs="pose", outputs="command")
def decide(node, pose):
    command = node.make_packet("command")
    command.data = -0.5 * pose.data
    return command
"""


def port(name: str, kind: str = "std_msgs/msg/Float64") -> dict[str, str]:
    return {"name": name, "type": kind}


def cart(folder: Path) -> Path:
    """A robot that drives the project, and a brain that brings it back to 0."""
    made = folder / "cart"
    made.mkdir()
    (made / "robot.py").write_text(ROBOT)
    (made / "brain.py").write_text(BRAIN)
    robot = {
        "name": "robot",
        "plugin": "robot.py",
        "inputs": [port("wheels"), port("push")],
        "outputs": [port("pose"), port("clock", "rosgraph_msgs/msg/Clock")],
    }
    brain = {
        "name": "brain",
        "plugin": "brain.py",
        "inputs": [port("pose")],
        "outputs": [port("command")],
    }
    wires = [("robot", "pose", "brain", "pose"), ("brain", "command", "robot", "wheels")]
    keys = ("source_node", "source_output", "destination_node", "destination_input")
    project = {
        "nodes": [{**node, "container": "neuros_python"} for node in (robot, brain)],
        "connections": [{**dict(zip(keys, w, strict=True)), "discard_limit": 0} for w in wires],
    }
    (made / "project.json").write_text(json.dumps(project, indent=1))
    return made
