"""In one process a packet goes through a chain of nodes without a copy, if no hook keeps it."""

from __future__ import annotations

import json
from pathlib import Path

from launching import launch

IMAGE, STAMPED = "sensor_msgs/msg/Image", "geometry_msgs/msg/PointStamped"
COUNT = 5

SOURCE = f"""
from neuros.hooks import *

@neuros_function(outputs="image")
def send(node):
    sent = (node.get_user_data() or 0) + 1
    node.set_user_data(sent)
    if sent == {COUNT}:
        node.shutdown("all sent")
    image = node.make_packet("image")
    image.data = bytes(100)
    note(node, image)
    return image
"""

RELAY = """
from neuros.hooks import *

kept = []

@neuros_function(inputs="image", outputs=[Optional("same"), Optional("stamped")])
def pass_on(node, image):
    note(node, image)
    stamped = node.make_packet("stamped")
    stamped.header.stamp = image.header.stamp
    note(node, stamped)
    {also}
    return {result}
"""

SINK = """
from neuros.hooks import *

@neuros_function(inputs="packet")
def look(node, packet):
    note(node, packet)
"""

NOTE = """

def note(node, packet):
    with (node.run_dir / "seen").open("a") as file:
        print(type(packet).__name__, id(packet), file=file)
"""


def seen(folder: Path, *, result: str, also: str = "pass") -> dict[str, list[str]]:
    """What each node notes of the packets that it has in hand: their class, and which it is."""
    plugins = {"source": SOURCE, "relay": RELAY.format(result=result, also=also), "sink": SINK}
    for name, text in plugins.items():
        (folder / f"{name}.py").write_text(text + NOTE)
    image = {"name": "image", "type": IMAGE}
    same, stamped = {"name": "same", "type": IMAGE}, {"name": "stamped", "type": STAMPED}
    nodes = [
        {"name": "source", "plugin": "source.py", "outputs": [image]},
        {"name": "relay", "plugin": "relay.py", "inputs": [image], "outputs": [same, stamped]},
        {"name": "images", "plugin": "sink.py", "inputs": [{"name": "packet", "type": IMAGE}]},
        {"name": "stamps", "plugin": "sink.py", "inputs": [{"name": "packet", "type": STAMPED}]},
    ]
    nodes = [{**node, "container": "neuros_python"} for node in nodes]
    ways = [
        ("source", "image", "relay", "image"),
        ("relay", "same", "images", "packet"),
        ("relay", "stamped", "stamps", "packet"),
    ]
    keys = ("source_node", "source_output", "destination_node", "destination_input")
    connections = [{**dict(zip(keys, way, strict=True)), "discard_limit": 0} for way in ways]
    project = {"nodes": nodes, "connections": connections}
    (folder / "project.json").write_text(json.dumps(project))
    finished = launch(folder, "--backend", "in-process", cwd=folder)
    assert finished.exit_code == 0, finished.output
    lines = {n: (finished.run_folder / n / "seen") for n in ("source", "relay", "images", "stamps")}
    found = {n: path.read_text().splitlines() if path.exists() else [] for n, path in lines.items()}
    assert len(found["source"]) == COUNT
    return found


def test_a_packet_that_a_hook_returns_as_it_came_is_handed_over_itself(tmp_path: Path) -> None:
    found = seen(tmp_path, result="image, None")
    assert found["images"] == found["source"]


def test_a_stamp_that_is_passed_on_costs_no_copy_either(tmp_path: Path) -> None:
    found = seen(tmp_path, result="None, stamped")
    assert found["stamps"] == [line for line in found["relay"] if line.startswith("Point")]


def test_what_the_hook_keeps_is_copied(tmp_path: Path) -> None:
    found = seen(tmp_path, result="image, None", also="kept.append(image)")
    assert len(found["images"]) == COUNT
    assert not set(found["images"]) & set(found["source"])


def test_a_packet_on_its_way_twice_is_copied(tmp_path: Path) -> None:
    found = seen(tmp_path, result="image, stamped")
    assert len(found["images"]) == len(found["stamps"]) == COUNT
    both = zip(found["images"], found["source"], strict=True)
    assert not any(received == sent for received, sent in both)
