"""Threads that send: a simulator that steps itself, and a plugin's own, on both back ends."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launching import BACKENDS, Finished, launch

TIMEOUT_S = 40.0

ROBOT = """
import os
from neuros.hooks import neuros_finalise, neuros_initialise, neuros_tick
from neuros.simulators.mujoco import MuJoCo

WORLD = '''<mujoco><option timestep="0.002"/><worldbody><body name="b"><freejoint name="j"/>
<geom size=".1"/></body></worldbody></mujoco>'''

@neuros_initialise()
def start(node):
    sim = MuJoCo(node, WORLD)
    node.set_user_data(sim)
    sim.run_asynchronous(None)
"""
ENDS = """
@neuros_tick(seconds=0.005)
def watch(node):
    if node.get_user_data().sim_time >= 1.0:
        node.shutdown("enough")
"""
EXPLODES = """
@neuros_tick(seconds=0.05)
def explode(node):
    sim = node.get_user_data()
    with sim.paused():
        sim.data.joint("j").qvel[0] = 1e300
"""
OBEYS = """
from neuros.hooks import neuros_function

@neuros_function(inputs="torque")
def obey(node, torque):
    node.get_user_data().command("torque", torque)
"""
THREAD = """
import threading
from neuros.hooks import neuros_finalise, neuros_initialise
from std_msgs.msg import Float64

@neuros_initialise()
def start(node):
    thread = threading.Thread(target=lambda: work(node), name="worker", daemon=True)
    node.set_user_data(thread)
    thread.start()

@neuros_finalise()
def join(node):
    thread = node.get_user_data()
    thread.join(4.0)
    (node.run_dir / "alive").write_text(str(thread.is_alive()))
"""
SENDS_FOR_EVER = """
def work(node):
    count = 0
    while node.submit({"out": Float64(data=float(count))}, lambda: False):
        count += 1
    (node.run_dir / "sent").write_text(str(count))
"""
SENDS_LATE = """
def work(node):
    threading.Event().wait(4.0)  # longer than it takes to find a deadlock
    node.submit({"out": Float64(data=1.0)}, lambda: False)
"""
SENDS_THE_WRONG_TYPE = """
def work(node):
    node.submit({"out": 7}, lambda: False)
"""
SLOW = """
import time
from neuros.hooks import neuros_function

@neuros_function(inputs="x")
def take(node, x):
    time.sleep(0.01)
"""
STUCK = """
from neuros.hooks import neuros_function

@neuros_function(inputs=["x", "never"])
def take(node, x, never):
    pass
"""
ENDS_AT_FIRST = """
from neuros.hooks import neuros_function

@neuros_function(inputs="x")
def take(node, x):
    node.shutdown("it came")
"""
RING = """
from neuros.hooks import neuros_function

@neuros_function(inputs=["x", "back"], outputs="out")
def take(node, x, back):
    return back
"""
ECHO = """
from neuros.hooks import neuros_function

@neuros_function(inputs="x", outputs="out")
def take(node, x):
    return x
"""

CLOCK = "rosgraph_msgs/msg/Clock"
FLOAT = "std_msgs/msg/Float64"
CONNECTION = "sender.out -> receiver.x"


def project(folder: Path, sender: str, receiver: str, **inputs: str | None) -> Path:
    """A sender with one lossless connection; ``inputs`` of the receiver beside it, by topic."""
    is_simulator = sender.startswith(ROBOT)
    type_ = CLOCK if is_simulator else FLOAT
    output = {"name": "out", "type": type_}
    if is_simulator:
        output["mujoco"] = {"sensor": "clock", "rate": 100}
    others = [{"name": name, "type": type_, "external_topic": t} for name, t in inputs.items()]
    nodes = [
        {"name": "sender", "container": "neuros_mujoco", "plugin": "sender.py"},
        {"name": "receiver", "container": "neuros_python", "plugin": "receiver.py"},
    ]
    nodes[0]["outputs"] = [output]
    nodes[1]["inputs"] = [{"name": "x", "type": type_}, *others]
    (folder / "sender.py").write_text(sender)
    (folder / "receiver.py").write_text(receiver)
    return written(folder, nodes, [wire("sender.out", "receiver.x")])


def wire(source: str, destination: str) -> dict[str, object]:
    (a, b), (c, d) = source.split("."), destination.split(".")
    ends = {"source_node": a, "source_output": b, "destination_node": c, "destination_input": d}
    return {**ends, "discard_limit": 0}


def written(folder: Path, nodes: object, connections: object) -> Path:
    file = folder / "project.json"
    file.write_text(json.dumps({"nodes": nodes, "connections": connections}))
    return file


@pytest.fixture(params=BACKENDS)
def run(request, tmp_path):
    """Run the project of this test's folder."""

    def launched(*arguments: str) -> Finished:
        options = {"cwd": tmp_path, "timeout_s": TIMEOUT_S, "NEUROS_GUI": "0"}
        return launch(tmp_path, "--backend", request.param, *arguments, **options)

    return launched


def counts(run: Finished) -> tuple[int, ...]:
    found = run.connection(CONNECTION)
    return tuple(found[key] for key in ("sent", "received", "consumed", "discarded", "lost"))


def test_the_stepping_waits_for_a_slow_receiver_and_nothing_is_lost(run, tmp_path):
    pytest.importorskip("mujoco")
    project(tmp_path, ROBOT + ENDS, SLOW)
    ended = run()
    assert ended.exit_code == 0, ended.output
    sent = counts(ended)[0]
    assert counts(ended) == (sent, sent, sent, 0, 0)
    # Unhindered it would be far ahead; it has stepped to the packet that it could not send.
    assert sent + 1 >= 100
    assert ended.record["sim_s"] <= 0.01 * (sent + 1) + 0.0021


def test_a_run_ends_drained_while_the_stepping_is_blocked(run, tmp_path):
    pytest.importorskip("mujoco")
    project(tmp_path, ROBOT, STUCK, never="/nobody/publishes/this")
    ended = run("--duration", "1")
    assert ended.exit_code == 0, ended.output
    assert counts(ended) == (1, 1, 0, 0, 0)
    assert ended.record["sim_s"] == pytest.approx(0.02)


@pytest.mark.parametrize("has_sensor", [True, False], ids=["a rare sensor", "no sensor"])
def test_a_simulated_duration_is_kept_whatever_the_simulator_sends(run, tmp_path, has_sensor):
    pytest.importorskip("mujoco")
    motor = '<actuator><motor name="m" joint="j" gear="1 0 0 0 0 0"/></actuator></mujoco>'
    (tmp_path / "robot.py").write_text(ROBOT.replace("</mujoco>", motor) + OBEYS)
    robot = {"name": "robot", "container": "neuros_mujoco", "plugin": "robot.py"}
    torque = {"name": "torque", "type": FLOAT, "external_topic": "/nobody/publishes/this"}
    robot["inputs"] = [torque | {"mujoco": {"actuator": "m"}}]
    if has_sensor:
        rare = {"name": "out", "type": CLOCK, "mujoco": {"sensor": "clock", "rate": 0.1}}
        robot["outputs"] = [rare]
    written(tmp_path, [robot], [])
    ended = run("--duration", "1sim")
    assert ended.exit_code == 0, ended.output
    assert ended.output.splitlines()[-1].endswith("robot ended the project: 1 s of simulated time")
    assert ended.record["sim_s"] == pytest.approx(1.0, abs=0.05)


def test_an_error_in_the_stepping_thread_ends_the_project_with_its_cause(run, tmp_path):
    pytest.importorskip("mujoco")
    project(tmp_path, ROBOT + EXPLODES, SLOW)
    ended = run()
    assert ended.exit_code == 1
    assert "node 'sender' failed: " in ended.output.splitlines()[-1]
    assert "unstable between" in ended.output.splitlines()[-1]


def test_a_blocked_thread_of_a_plugin_is_released_by_the_end(run, tmp_path):
    project(tmp_path, THREAD + SENDS_FOR_EVER, STUCK, never="/nobody/publishes/this")
    ended = run("--duration", "1")
    assert ended.exit_code == 0, ended.output
    assert (ended.run_folder / "sender/sent").read_text() == "1"
    assert (ended.run_folder / "sender/alive").read_text() == "False"


def test_a_thread_that_has_not_sent_yet_is_no_deadlock(run, tmp_path):
    project(tmp_path, THREAD + SENDS_LATE, ENDS_AT_FIRST)
    ended = run()
    assert ended.exit_code == 0, ended.output
    assert counts(ended) == (1, 1, 1, 0, 0)


def test_a_packet_of_a_wrong_type_from_a_thread_is_named(run, tmp_path):
    project(tmp_path, THREAD + SENDS_THE_WRONG_TYPE, SLOW)
    ended = run()
    assert ended.exit_code == 1
    last = ended.output.splitlines()[-1]
    assert "node 'sender' failed: " in last
    assert "/sender.py: hook 'submit(out)': returned int for output 'out'" in last


def test_a_thread_that_is_blocked_for_ever_does_not_hide_a_deadlock(run, tmp_path):
    """The receiver also wants a packet that can only come after its own first."""
    number = {"type": FLOAT}
    nodes = [
        {"name": "sender", "container": "neuros_python", "plugin": "sender.py"},
        {"name": "receiver", "container": "neuros_python", "plugin": "receiver.py"},
        {"name": "echo", "container": "neuros_python", "plugin": "echo.py"},
    ]
    nodes[0]["outputs"] = nodes[1]["outputs"] = nodes[2]["outputs"] = [{"name": "out", **number}]
    nodes[1]["inputs"] = [{"name": "x", **number}, {"name": "back", **number}]
    nodes[2]["inputs"] = [{"name": "x", **number}]
    for name, plugin in (("sender", THREAD + SENDS_FOR_EVER), ("receiver", RING), ("echo", ECHO)):
        (tmp_path / f"{name}.py").write_text(plugin)
    wires = [
        wire("sender.out", "receiver.x"),
        wire("receiver.out", "echo.x"),
        wire("echo.out", "receiver.back"),
    ]
    written(tmp_path, nodes, wires)
    ended = run()
    assert ended.exit_code == 1
    assert "deadlock: nothing can ever run again" in ended.output
    assert "receiver waits for `back` from echo" in ended.output
    assert (ended.run_folder / "sender/alive").read_text() == "False"
