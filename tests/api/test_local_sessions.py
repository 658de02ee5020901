"""Sessions whose nodes are in its own thread: what they leave alone, and how they fail."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import rclpy
from api_projects import ENDLESS, dice
from cart_project import cart, port
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Float64

import neuros
from containers import wait_until
from neuros.api.local_run import NAME
from neuros.api.session import Session
from neuros.errors import HookError, RunError, UsageError

DEADLINE_S = 60.0

LOOKS_AROUND = """
import os, sys
import helper
from neuros.hooks import neuros_function, neuros_finalise

@neuros_function(outputs="x")
def look(node):
    node.get_logger().warning("looking")
    (node.run_dir / "seen").write_text(os.getcwd())
    open("mine", "w").close()
    assert os.environ["OWN"] == "1" and "helper" in sys.modules
    x = node.make_packet("x")
    x.data = helper.VALUE
    return x

@neuros_finalise()
def end(node):
    (node.run_dir / "ended").write_text("well")
"""
HANGS = """
from neuros.hooks import neuros_function

@neuros_function(outputs="x")
def spin(node):
    while True:
        pass
"""
INTERRUPTED = """
import signal
from neuros.hooks import neuros_function

@neuros_function(outputs="x")
def work(node):
    x = node.make_packet("x")
    x.data = node.get_user_data() or 0.0
    node.set_user_data(x.data + 1.0)
    if x.data == 1.0:
        signal.raise_signal(signal.SIGINT)  # Ctrl+C, in the midst of a hook
    return x
"""
TALKER = """
from std_msgs.msg import Float64
from neuros.hooks import neuros_function, neuros_initialise

@neuros_initialise()
def begin(node):
    ros = node.get_ros_node()
    assert ros.get_parameter("gain").value == 2.0
    if node.description.environment.get("TALKS"):
        publisher = ros.create_publisher(Float64, "/said", 10)
        node.set_user_data((publisher, []))
        ros.create_subscription(Float64, "/heard", lambda m: node.get_user_data()[1].append(m), 10)

@neuros_function(outputs="x")
def say(node):
    x = node.make_packet("x")
    if node.get_user_data():
        publisher, heard = node.get_user_data()
        publisher.publish(Float64(data=1.0))
        x.data = float(len(heard))
    return x
"""
TYPE = "std_msgs/msg/Float64"


def project_of(folder: Path, plugin: str, **keys: object) -> neuros.Project:
    """One node ``a`` with an output ``x``."""
    (folder / "plugin.py").write_text(plugin)
    (folder / "helper.py").write_text("VALUE = 3.0")
    node = {"name": "a", "plugin": "plugin.py", "container": "neuros_python", **keys}
    node.setdefault("outputs", [port("x")])
    (folder / "project.json").write_text(json.dumps({"nodes": [node]}))
    return neuros.Project.from_file(folder)


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NEUROS_BACKEND", raising=False)


class TestTheProgram:
    def test_no_process_and_no_thread_is_started_and_ros_is_left_alone(
        self, tmp_path: Path
    ) -> None:
        threads, children = {*threading.enumerate()}, psutil.Process().children()
        with neuros.Project.from_file(cart(tmp_path)).session() as s:
            s.step(3)
            assert psutil.Process().children() == children
            others = {*threading.enumerate()} - threads
            assert {each.name for each in others} <= {"neuros-git"}  # it asks git, once
            assert s._held._middleware._ros is None  # type: ignore[attr-defined]
        assert s.close().backend == NAME == "local"

    def test_nodes_have_their_folder_environment_and_modules_and_the_program_keeps_its_own(
        self, tmp_path: Path
    ) -> None:
        project = project_of(tmp_path, LOOKS_AROUND, environment={"OWN": "1"})
        handler = signal.getsignal(signal.SIGINT)
        path, modules = [*sys.path], {*sys.modules}
        with project.session() as s:
            s.step()
            assert (Path.cwd(), os.environ.get("OWN")) == (tmp_path, None)
            assert sys.path == path
            assert {each for each in {*sys.modules} - modules if "helper" in each} == set()
            assert s["a.x"].packet.data == 3.0
        run = s.close()
        assert signal.getsignal(signal.SIGINT) == handler
        assert (run.folder / "a" / "seen").read_text() == str(run.folder)
        assert (run.folder / "mine").exists()
        assert (run.folder / "a" / "ended").read_text() == "well"

    def test_the_log_of_a_node_is_a_file_and_in_pythons_logging(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        with project_of(tmp_path, LOOKS_AROUND, environment={"OWN": "1"}).session() as s:
            s.step()
        assert ("neuros.a", logging.WARNING, "looking") in caplog.record_tuples
        assert "[WARN]" in s.close().log("a")

    def test_an_ended_session_has_a_record_like_any_run(self, tmp_path: Path) -> None:
        with neuros.Project.from_file(dice(tmp_path)).session(seed=4) as s:
            assert not s.step(20)
        run = s.close()
        assert (run.exit_code, run.reason) == (0, "counter ended the project: ten were thrown")
        (connection,) = run.record["connections"]
        assert [connection[key] for key in ("sent", "consumed", "lost")] == [10, 10, 0]
        assert sum(run.node_results["counter"]["eyes"]) == run.node_results["counter"]["sum"]
        assert run.record["options"]["backend"] == "local"

    def test_sessions_side_by_side_have_nothing_in_common(self, tmp_path: Path) -> None:
        project = neuros.Project.from_file(dice(tmp_path, ENDLESS))
        with project.session(seed=1) as first, project.session(seed=1) as second:
            for _ in range(5):
                first.step()
                second.step()
                eyes = [s["thrower.eyes"].packet.data for s in (first, second)]
                assert eyes[0] == eyes[1]


class TestFailures:
    def test_the_error_of_a_hook_is_the_cause_of_that_of_the_step(self, tmp_path: Path) -> None:
        with neuros.Project.from_file(cart(tmp_path)).session(take_over="robot.wheels") as s:
            s.step()
            s.send("robot.wheels", Float64(data=13.0))
            with pytest.raises(RunError, match=r"node 'robot' failed: .*a wheel has broken") as e:
                s.step()
            assert isinstance(e.value.__cause__, HookError)
            assert isinstance(e.value.__cause__.__cause__, RuntimeError)
        assert s.close().exit_code == 1
        assert "a wheel has broken" in s.close().log("robot")

    def test_a_hook_that_does_not_return_is_interrupted_and_named_with_its_place(
        self, tmp_path: Path
    ) -> None:
        with project_of(tmp_path, HANGS).session() as s:
            with pytest.raises(TimeoutError, match=r"(?s)node 'a': hook 'spin' .*plugin\.py"):
                s.step(timeout_s=0.05)
            with pytest.raises(RunError, match=r"node 'a' failed: .*plugin\.py:6: hook 'spin'"):
                s.step()
        assert s.close().exit_code == 1

    def test_ctrl_c_waits_for_the_hook_and_the_program_may_go_on(self, tmp_path: Path) -> None:
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            with project_of(tmp_path, INTERRUPTED).session() as s:
                s.step()
                with pytest.raises(KeyboardInterrupt):
                    s.step()
                s.step()
                assert [packet.data for packet in s["a.x"].packets] == [0.0, 1.0, 2.0]
            assert s.close().exit_code == 0
        finally:
            signal.signal(signal.SIGINT, before)

    def test_what_a_program_of_its_own_thread_cannot_have_is_refused(self, tmp_path: Path) -> None:
        project = project_of(tmp_path, HANGS)
        with pytest.raises(UsageError, match=r"backend='local' .*record"):
            project.session(backend="local", record=True)


class TestRos:
    def test_a_plugin_gets_a_real_ros_node_when_it_uses_one(self, tmp_path: Path) -> None:
        project = project_of(
            tmp_path, TALKER, parameters={"gain": 2.0}, environment={"TALKS": "yes"}
        )
        with _Outside() as outside, project.session() as s:
            heard = outside.subscribe("/said")
            publisher = outside.node.create_publisher(Float64, "/heard", 10)

            def is_there() -> bool:
                publisher.publish(Float64())
                outside.serve()
                s.step()
                return bool(heard) and s["a.x"].packet.data > 0

            wait_until(is_there, DEADLINE_S)

    def test_parameters_alone_need_no_ros(self, tmp_path: Path) -> None:
        with project_of(tmp_path, TALKER, parameters={"gain": 2.0}).session() as s:
            s.step()
            assert s._held._middleware._ros is None  # type: ignore[attr-defined]

    def test_an_external_topic_is_on_the_ros_graph(self, tmp_path: Path) -> None:
        x = [{**port("x"), "external_topic": "/x"}]
        with (
            _Outside() as outside,
            project_of(
                tmp_path, INTERRUPTED.replace("== 1.0", "== -1.0"), outputs=x
            ).session() as s,
        ):
            heard = outside.subscribe("/x")

            def is_there() -> bool:
                s.step()
                outside.serve()
                return bool(heard)

            wait_until(is_there, DEADLINE_S)

    def test_ros_tools_see_the_topics_of_a_session_that_exposes_them(self, tmp_path: Path) -> None:
        with (
            _Outside() as outside,
            neuros.Project.from_file(cart(tmp_path)).session(expose=True) as s,
        ):
            topic = "/neuros/robot/pose/brain/pose/data"
            heard = outside.subscribe(topic)

            def is_there() -> bool:
                s.run(duration_s=0.05)
                s.step()
                outside.serve()
                return bool(heard)

            wait_until(is_there, DEADLINE_S)


class _Outside:
    """Another ROS node of this machine."""

    def __enter__(self) -> _Outside:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("outside", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def subscribe(self, topic: str) -> list[Float64]:
        heard: list[Float64] = []
        self.node.create_subscription(Float64, topic, heard.append, 10)
        return heard

    def serve(self) -> None:
        self._executor.spin_once(timeout_sec=0.01)


@pytest.fixture(params=["local", "in-process", "process"])
def back_end(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def stepped(back_end: str, tmp_path: Path) -> Iterator[Session]:
    """A cart on each back end."""
    with neuros.Project.from_file(cart(tmp_path)).session(backend=back_end) as s:
        yield s


class TestHistory:
    def test_what_led_to_a_failure_can_be_read_after_it(
        self, tmp_path: Path, back_end: str
    ) -> None:
        project = neuros.Project.from_file(cart(tmp_path))
        with project.session(take_over="robot.wheels", backend=back_end) as s:
            s.step(2)
            assert s["robot.pose"].count == 2
            s.send("robot.wheels", Float64(data=13.0))
            with pytest.raises(RunError, match="a wheel has broken"):
                s.step(timeout_s=DEADLINE_S)
            count = s["brain.command"].count  # looked at for the first time
            assert count >= 2
            assert len(s["brain.command"].packets) == count
            assert s["robot.pose"].packet.data == 1.0

    def test_all_packets_since_the_last_look_are_there(self, stepped: Session) -> None:
        stepped.step(5)
        assert len(stepped["robot.pose"].packets) == 5
        assert stepped["robot.pose"].packets == []
        stepped.step(3)
        stepped.step(2)
        packets = stepped["robot.pose"].packets
        assert len(packets) == 5
        assert packets[-1].data == stepped["robot.pose"].packet.data
        assert stepped["robot.pose"].dropped == 0

    def test_what_is_dropped_is_counted_and_said(self, tmp_path: Path) -> None:
        with neuros.Project.from_file(cart(tmp_path)).session() as s:
            s.step(1200)
            assert s["robot.pose"].dropped == 200
            with pytest.warns(UserWarning, match=r"robot\.pose: 200 packets were dropped"):
                assert len(s["robot.pose"].packets) == 1000
            assert s["robot.pose"].dropped == 0

    def test_a_packet_that_a_program_reads_is_its_own(self, stepped: Session) -> None:
        stepped.step()
        stepped["robot.pose"].packet.data = 77.0
        assert stepped["robot.pose"].packet.data == 1.0
        stepped["robot.pose"].packets[0].data = 77.0
        assert stepped["robot.pose"].packet.data == 1.0

    def test_a_probe_keeps_every_packet_or_every_nth_as_arrays_and_over_resets(
        self, stepped: Session
    ) -> None:
        poses, thirds = stepped.probe("robot.pose"), stepped.probe("robot.pose", every=3)
        stepped.step(6)
        poses_of_before = poses.array("data").tolist()
        assert [len(poses), len(thirds)] == [6, 2]
        assert thirds.array("data").tolist() == poses_of_before[::3]
        stepped.reset()
        stepped.step(2)
        assert len(poses) == 8
        assert poses.array("data").tolist()[6:] == poses_of_before[:2]
        with pytest.raises(UsageError, match="has no field 'date'"):
            poses.array("date")
        with pytest.raises(UsageError, match="every=0"):
            stepped.probe("robot.pose", every=0)


NEST_IN_THE_PROGRAM = """
import sys
import nest
import neuros
from neuros.errors import UsageError

nest.Create("iaf_psc_alpha", 5)
with neuros.Project.from_file("plain").session(backend="local") as s:
    s.step()
    s.reset()
    assert not s.runs, "NEST is the program's, and binds no node"
    assert nest.network_size == 5
with neuros.Project.from_file("spiking").session(backend="local") as s:
    for _ in range(2):
        s.step()
        assert s["a.x"].packet.data == 3.0, "NEST begins anew"
        s.reset()
    assert len(s.runs) == 2
    try:
        neuros.Project.from_file("spiking").session(backend="local")
    except UsageError as error:
        assert "NEST has one kernel per process" in str(error)
    else:
        sys.exit("two sessions use NEST at once")
"""
SPIKING = """
import nest
from neuros.hooks import neuros_function, neuros_initialise

@neuros_initialise()
def begin(node):
    nest.Create("iaf_psc_alpha", 3)

@neuros_function(outputs="x")
def go(node):
    x = node.make_packet("x")
    x.data = float(nest.network_size)
    return x
"""


def test_nest_is_the_programs_until_a_node_uses_it(tmp_path: Path) -> None:
    for name, plugin in (("plain", INTERRUPTED.replace("== 1.0", "== -1.0")), ("spiking", SPIKING)):
        (tmp_path / name).mkdir()
        project_of(tmp_path / name, plugin)
    program = [sys.executable, "-W", "ignore", "-c", NEST_IN_THE_PROGRAM]
    run = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
