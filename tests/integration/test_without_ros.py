"""In process with ``--no-ros``: no ROS participant before something in the project asks for one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from launching import Finished, launch, start
from ros_program import RosProgram
from test_back_ends import PROJECTS, talk_to_the_gate

from neuros.backends.domain import choose_domain

TIMEOUT_S = 60.0
NUMBER = "std_msgs/msg/Int32"

# The native threads of a process tell whether it has a participant: DDS names its own.
SENDER = """
from pathlib import Path
from neuros.hooks import neuros_finalise, neuros_initialise, neuros_function

@neuros_initialise(outputs="number")
def begin(node):
    return node.make_packet("number")

@neuros_function(inputs="back", outputs="number")
def send(node, back):
    back.data += 1
    return back

@neuros_finalise()
def end(node):
    threads = (task.read_text() for task in Path("/proc/self/task").glob("*/comm"))
    (node.run_dir / "dds").write_text(str(sum(name.startswith("dds") for name in threads)))
"""
ECHO = """
from neuros.hooks import neuros_function, neuros_initialise

{first}

@neuros_function(inputs="number", outputs="back")
def echo(node, number):
    {echo}
    return number
"""


def project(folder: Path, echo: str, first: str = "", **keys: Any) -> Path:
    """Two nodes that pass a number to and fro, one of them with these lines in its hook."""
    (folder / "sender.py").write_text(SENDER)
    (folder / "echo.py").write_text(ECHO.format(echo=echo, first=first))
    ports = {"sender": ("back", "number"), "echo": ("number", "back")}
    nodes = [
        {
            "name": name,
            "container": "neuros_python",
            "plugin": f"{name}.py",
            "inputs": [{"name": taken, "type": NUMBER}],
            "outputs": [{"name": given, "type": NUMBER}],
        }
        for name, (taken, given) in ports.items()
    ]
    connections = [
        {
            "source_node": a,
            "source_output": port,
            "destination_node": b,
            "destination_input": port,
            "discard_limit": 0,
        }
        for a, port, b in (("sender", "number", "echo"), ("echo", "back", "sender"))
    ]
    file = folder / "project.json"
    file.write_text(json.dumps({"nodes": nodes, "connections": connections, **keys}))
    return file


def run(file: Path, *arguments: str) -> Finished:
    finished = launch(
        file,
        "--backend",
        "in-process",
        "--no-ros",
        *arguments,
        cwd=file.parent,
        timeout_s=TIMEOUT_S,
    )
    assert finished.exit_code == 0, finished.output
    return finished


def dds_threads(finished: Finished) -> int:
    return int((finished.run_folder / "sender" / "dds").read_text())


def test_there_is_no_participant(tmp_path: Path) -> None:
    finished = run(project(tmp_path, "number.data < 100 or node.shutdown('enough')"))
    assert dds_threads(finished) == 0
    assert finished.connection("echo.back -> sender.back")["consumed"] >= 100
    assert "ros2 topic" not in finished.output


def test_name_logger_and_parameters_need_none(tmp_path: Path) -> None:
    look = (
        "ros = node.get_ros_node(); "
        "ros.get_logger().info(f\"{ros.get_name()}: {ros.get_parameter('gain').value}\"); "
        "node.shutdown('enough')"
    )
    file = project(tmp_path, look)
    content = json.loads(file.read_text())
    content["nodes"][1]["parameters"] = {"gain": 2.5}
    file.write_text(json.dumps(content))
    finished = run(file)
    assert dds_threads(finished) == 0
    assert "[echo]: echo: 2.5" in finished.output


def test_a_logger_is_that_of_ros(tmp_path: Path) -> None:
    log = (
        "log = node.get_logger(); log.debug('seen with -v'); "
        "log.info('often', throttle_duration_sec=60.0); "
        "number.data < 100 or node.shutdown('enough')"
    )
    file = project(tmp_path, log, namespace="left")
    quiet, verbose = run(file), run(file, "-v")
    assert quiet.output.count("[left.echo]: often") == 1
    assert "seen with -v" not in quiet.output
    assert "[DEBUG]" in verbose.output
    assert "[left.echo]: seen with -v" in verbose.output


@pytest.mark.parametrize("where", ["hook", "thread"])
def test_a_plugin_that_asks_in_a_hook_is_served_from_then_on(tmp_path: Path, where: str) -> None:
    """Its timer runs between hooks, which go on: neither keeps the other waiting."""
    first = """
import threading

counts = {"hooks": 0, "timer": 0}

def ask(node):
    node.get_ros_node().create_timer(0.001, lambda: count(node))

def count(node):
    counts["timer"] += 1
    hooks = counts.setdefault("hooks at first", counts["hooks"])
    if counts["timer"] >= 10 and counts["hooks"] >= hooks + 100:
        node.shutdown("both ran")
"""
    call = {"hook": "ask(node)", "thread": "threading.Thread(target=ask, args=(node,)).start()"}
    echo = f"counts['hooks'] += 1; counts['hooks'] == 50 and {call[where]}"
    finished = run(project(tmp_path, echo, first))
    assert dds_threads(finished) > 0
    assert "both ran" in finished.output
    for name in ("echo.back -> sender.back", "sender.number -> echo.number"):
        counters = finished.connection(name)
        assert counters["sent"] == counters["received"] >= 150


def test_external_topics_and_services_are_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with choose_domain(None, {}, False) as domain:
        arguments = ("--backend", "in-process", "--no-ros", "-d", str(domain.id))
        with (
            RosProgram(domain_id=domain.id) as program,
            start(PROJECTS / "outside", *arguments, cwd=tmp_path) as running,
        ):
            talk_to_the_gate(program, hears_connections=False)
            topics = {name for name, _ in program.node.get_topic_names_and_types()}
            finished = running.finish(TIMEOUT_S)
    assert finished.exit_code == 0, finished.output
    assert "/answered" in topics
    assert not any(name.startswith("/neuros/") for name in topics)


def test_a_failing_callback_ends_the_run_as_with_ros(tmp_path: Path) -> None:
    fail = "1 / (number.data != 50 or node.get_ros_node().create_timer(0.001, lambda: 1 / 0) and 1)"
    finished = launch(project(tmp_path, fail), "--backend", "in-process", "--no-ros", cwd=tmp_path)
    assert finished.exit_code == 1
    assert "ZeroDivisionError" in finished.output
    assert "node 'echo' failed" in finished.output
