"""Programs that publish on the topics of a connection without being one of its nodes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from launching import start
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from ros_program import RosProgram
from std_msgs.msg import Int32, String, UInt64

from neuros.backends.domain import choose_domain

LATCHED = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
TOPIC = "/neuros/source/number/sink/number"
PLUGIN = """
from neuros.hooks import neuros_function, neuros_tick

if {is_source}:
    @neuros_tick(seconds=0.01, outputs="number")
    def count(node):
        return node.make_packet("number")
else:
    @neuros_function(inputs="number")
    def receive(node, number):
        if (node.run_dir / "enough").exists():
            node.shutdown("that is enough")
"""


@pytest.fixture(scope="module")
def domain() -> Iterator[int]:
    with choose_domain(None, {}, False) as lock:
        yield lock.id


@pytest.mark.parametrize(
    ("part", "kind", "name", "node"),
    [
        ("data", Int32, "intruder", "sink"),
        ("data", Int32, "source", "sink"),  # as a second copy of the source
        ("ack", UInt64, "intruder", "source"),
        ("reg", String, "intruder", "source"),
    ],
)
def test_a_run_goes_on_and_names_who_else_publishes(
    part: str, kind: type, name: str, node: str, domain: int, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    project = write_project(tmp_path)
    with (
        start(project, "-d", str(domain), "-o", str(folder), cwd=tmp_path) as running,
        RosProgram(name, domain) as program,
    ):
        program.node.create_publisher(kind, f"{TOPIC}/{part}", LATCHED)
        connection = f"[{node}]: source.number -> sink.number"
        running.wait_for(f"{connection}: on {TOPIC}/{part}, others publish, too: {name}.", 60.0)
        (folder / "sink" / "enough").touch()
        run = running.finish(60.0)
    assert run.exit_code == 0, run.output
    (line,) = (each for each in run.output.splitlines() if f"[{node}]: source.number ->" in each)
    assert "--isolate" in line
    assert run.connection("source.number -> sink.number")["lost"] == 0


def write_project(folder: Path) -> Path:
    number = {"name": "number", "type": "std_msgs/msg/Int32"}
    nodes = []
    for name, ports in {"source": "outputs", "sink": "inputs"}.items():
        (folder / f"{name}.py").write_text(PLUGIN.format(is_source=name == "source"))
        nodes.append(
            {"name": name, "plugin": f"{name}.py", "container": "neuros_python", ports: [number]}
        )
    connection = {
        "source_node": "source",
        "source_output": "number",
        "destination_node": "sink",
        "destination_input": "number",
        "discard_limit": 0,
    }
    file = folder / "project.json"
    file.write_text(json.dumps({"nodes": nodes, "connections": [connection]}))
    return file
