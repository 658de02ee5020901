"""What the figures of a run say of a time in which it was paused."""

from __future__ import annotations

import json
import select
import time
from pathlib import Path

import pytest
from integration.test_steps_outside import observing
from launching import BACKENDS

import neuros
from neuros.control import GetStatus, NodeStatus, Pause, Resume
from neuros.control.link import ControlLink

INT32 = "std_msgs/msg/Int32"
PAUSED_S = 1.5
LIMIT_S = 60.0
SENDS = """
from neuros.hooks import neuros_tick
@neuros_tick(seconds=0.01, outputs="x")
def send(node):
    return node.make_packet("x")
"""
# It is behind its sender, so that packets wait whenever the run is paused.
TAKES = """
import time
from neuros.hooks import neuros_function
@neuros_function(inputs="x")
def take(node, x):
    time.sleep(0.05)
"""


def executions(link: ControlLink) -> int:
    """How often the hook of the receiver has run."""
    link.send(GetStatus({}))
    while select.select([link], [], [], 1.0)[0]:
        for message in link.receive() or ():
            if isinstance(message, NodeStatus) and message.node == "b" and message.counters:
                return int(message.counters.metrics["hooks"]["take"]["executions"])
    return 0


def wait_for(link: ControlLink, count: int) -> None:
    deadline_s = time.monotonic() + LIMIT_S
    while executions(link) < count:
        assert time.monotonic() < deadline_s, f"{count} executions, not within {LIMIT_S:g} s"


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_time_of_a_pause_is_no_latency(backend: str, tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text(SENDS)
    (tmp_path / "b.py").write_text(TAKES)
    node, x = {"container": "neuros_python"}, {"name": "x", "type": INT32}
    nodes = [
        {**node, "name": "a", "plugin": "a.py", "outputs": [x]},
        {**node, "name": "b", "plugin": "b.py", "inputs": [x]},
    ]
    ends = ("source_node", "source_output", "destination_node", "destination_input")
    connection = {**dict(zip(ends, "axbx", strict=True)), "discard_limit": 0, "queue_size": 2}
    file = tmp_path / "project.json"
    file.write_text(json.dumps({"nodes": nodes, "connections": [connection]}))
    with neuros.Project.from_file(file).start(backend=backend, output=tmp_path / "run") as live:
        link = observing(live)
        wait_for(link, 5)
        link.send(Pause())
        paused_s = time.monotonic()
        while time.monotonic() < paused_s + PAUSED_S:
            before = executions(link)
        link.send(Resume())
        wait_for(link, before + 5)
        live.end()
        run = live.wait()
        link.close()
    latency = run.record["connections"][0]["latency_ms"]
    assert latency["count"] >= 10
    assert latency["max"] < 1000 * PAUSED_S, "packets that waited were held for longer than that"
