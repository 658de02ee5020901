"""``neuros topic`` and ``neuros logs`` show a run that goes on, on each back end, without ROS 2."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from launching import BACKENDS, Running, start

from neuros.backends.domain import choose_domain
from neuros.cli.main import main

INT = "std_msgs/msg/Int32"
TALKER = """
from neuros.hooks import neuros_tick

@neuros_tick(0.02, outputs=["count", "out"])
def tick(node):
    packet = node.make_packet("count")
    packet.data = 7
    return packet, packet
"""
LISTENER = """
from neuros.hooks import neuros_function

@neuros_function(inputs="count")
def hear(node, count):
    node.get_logger().info("heard")
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for name, text in (("talker", TALKER), ("listener", LISTENER)):
        (tmp_path / f"{name}.py").write_text(text)
    outside = {"name": "out", "type": INT, "external_topic": "/counted"}
    nodes = [
        {"name": "talker", "outputs": [{"name": "count", "type": INT}, outside]},
        {"name": "listener", "inputs": [{"name": "count", "type": INT}]},
    ]
    wire = {"source_node": "talker", "source_output": "count", "discard_limit": 0}
    wire |= {"destination_node": "listener", "destination_input": "count"}
    content = {
        "nodes": [
            {**node, "container": "neuros_python", "plugin": f"{node['name']}.py"} for node in nodes
        ],
        "connections": [wire],
    }
    (tmp_path / "project.json").write_text(json.dumps(content))
    return tmp_path


@pytest.fixture(params=BACKENDS)
def running(project: Path, request: pytest.FixtureRequest) -> Iterator[Running]:
    with choose_domain(None, {}, False) as domain:  # its external topic would have it join 0
        options = ("--backend", request.param, "-d", str(domain.id))
        with start(project, *options, cwd=project) as running:
            running.wait_for("heard", 30.0)
            yield running


def run_of(running: Running) -> str:
    found = re.search(r"neuros topic list (\w{8})(.*)", running.output)
    assert found
    return found[1]


def test_topics_are_listed_shown_and_counted(
    running: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    run, wire = run_of(running), "talker.count -> listener.count"
    assert main(["topic", "list", run, "--format", "json"]) == 0
    assert json.loads(capsys.readouterr().out) == [
        {
            "name": "/neuros/talker/count/listener/count/data",
            "type": INT,
            "connection": wire,
        },
        {"name": "/counted", "type": INT, "connection": None},
    ]
    for name in ("talker.count", wire, "/neuros/talker/count/listener/count/data", "/counted"):
        assert main(["topic", "echo", run, name, "-n", "2"]) == 0
        assert capsys.readouterr().out == "data: 7\n---\n" * 2
    assert main(["topic", "echo", run, "talker.count", "-n", "1", "--format", "json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"data": 7}
    assert main(["topic", "hz", run, "talker.count", "-n", "1", "--format", "json"]) == 0
    assert json.loads(capsys.readouterr().out)["packets_per_s"] > 0
    assert main(["topic", "hz", run, "talker.cout"]) == 2
    assert "no topic 'talker.cout' (did you mean 'talker.count'?)" in capsys.readouterr().err


def test_logs_are_followed_to_the_end_and_can_be_read_after_it(
    running: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [sys.executable, "-m", "neuros.cli", "logs", run_of(running), "-f", "-n", "listener"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as shown:
        assert shown.stdout is not None
        assert "[listener]: heard" in shown.stdout.readline()
        running.signal(signal.SIGINT)
        done = running.finish()
        lines = [*shown.stdout]
        assert shown.wait(30.0) == 0
    assert done.run_folder is not None
    log = (done.run_folder / "listener" / "node.log").read_text("utf-8")
    assert 1 + len(lines) == len(log.splitlines())
    assert main(["logs", str(done.run_folder)]) == 0
    assert "[listener]: heard" in capsys.readouterr().out
    assert main(["logs", str(done.run_folder), "-n", "nobody"]) == 2
    assert "the run has no node 'nobody': it has 'listener' or 'talker'" in capsys.readouterr().err
    assert main(["topic", "list", "0123456789"]) == 2
    assert "you have no run called '0123456789'" in capsys.readouterr().err
