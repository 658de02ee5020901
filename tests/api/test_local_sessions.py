"""Sessions whose nodes are in its own thread: what they leave alone, and how they fail."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

import psutil
import pytest
import rclpy
from api_projects import ENDLESS, dice
from cart_project import cart, port
from deadlines import wait_until
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Float64

import neuros
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
INTERRUPTS = """
import os, signal
from neuros.hooks import neuros_function, neuros_initialise

def interrupt(node, when):
    if os.environ.get("AT") == when:
        signal.raise_signal(signal.SIGINT)

@neuros_initialise()
def begin(node):
    interrupt(node, "start")

@neuros_function(outputs="x")
def work(node):
    interrupt(node, "work")
    return node.make_packet("x")
"""
USES_ITS_SESSION = """
import used
from neuros.hooks import neuros_function

@neuros_function(outputs="x")
def use(node):
    used.by(node)
    return node.make_packet("x")
"""
LOOKS_AT_ITS_PLACE = """
import os, time
from neuros.hooks import neuros_function

@neuros_function(outputs="x")
def look(node):
    time.sleep(0)  # let other threads go on
    assert os.getcwd() == str(node.run_dir.parent)
    assert os.environ["NEUROS_RUN_DIR"] == str(node.run_dir)
    return node.make_packet("x")
"""
SENDS_FROM_A_THREAD = """
import threading
from neuros.hooks import neuros_initialise, neuros_tick

def send(node):
    node.wait_until_active(lambda: False)
    number = 0.0
    while True:
        x = node.make_packet("x")
        x.data = number = number + 1.0
        if not node.submit({"x": x}, lambda: False):
            break

@neuros_initialise()
def begin(node):
    threading.Thread(target=send, args=(node,)).start()

@neuros_tick(3600.0)
def look(node): ...
"""
USES_NEST = """
import helper
from neuros.hooks import neuros_function

@neuros_function(outputs="x")
def look(node):
    return node.make_packet("x")
"""
SENDS_PICTURES = """
from neuros.hooks import neuros_function

@neuros_function(outputs="x")
def show(node):
    x = node.make_packet("x")
    x.data = bytes(1_000_000)
    return x
"""
SPEAKS = """
from rclpy.logging import LoggingSeverity
from neuros.hooks import neuros_function

@neuros_function(outputs="x")
def speak(node):
    log = node.get_logger()
    log.debug("detail")
    log.info("at first", once=True)
    log.info("now and then", throttle_duration_sec=3600.0)
    log.info("later", skip_first=True)
    log.get_child("inner").warn("always")
    log.set_level(LoggingSeverity.WARN)
    log.info("too much")
    assert not log.is_enabled_for(LoggingSeverity.INFO)
    log.set_level(LoggingSeverity.INFO)
    return node.make_packet("x")
"""
HEARS_ITSELF = """
from std_msgs.msg import Float64
from neuros.hooks import neuros_function, neuros_initialise

@neuros_initialise()
def begin(node):
    ros, heard = node.get_ros_node(), []
    node.set_user_data((ros.create_publisher(Float64, "/own", 10), heard))
    ros.create_subscription(Float64, "/own", heard.append, 10)

@neuros_function(outputs="x")
def say(node):
    publisher, heard = node.get_user_data()
    publisher.publish(Float64())
    x = node.make_packet("x")
    x.data = float(len(heard))
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


@contextlib.contextmanager
def using(
    folder: Path, monkeypatch: pytest.MonkeyPatch, use: Callable[[Session], object]
) -> Iterator[Session]:
    """A session whose hook is handed the session itself."""
    used = ModuleType("used")
    monkeypatch.setitem(sys.modules, "used", used)
    with project_of(folder, USES_ITS_SESSION).session() as s:
        used.by = lambda _: use(s)  # type: ignore[attr-defined]
        yield s


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Python's own handler of Ctrl+C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


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

    def test_a_node_logs_what_it_logs_elsewhere(self, tmp_path: Path, back_end: str) -> None:
        with project_of(tmp_path, SPEAKS).session(backend=back_end) as s:
            s.step(3, timeout_s=DEADLINE_S)
        lines = [line.partition("]: ")[2] for line in s.close().log("a").splitlines()]
        count = Counter(lines)
        said = ("detail", "at first", "now and then", "later", "always", "too much")
        assert [count[text] for text in said] == [0, 1, 1, 2, 3, 0]

    def test_a_log_takes_any_text(self, tmp_path: Path) -> None:
        says = LOOKS_AT_ITS_PLACE.replace(
            "    time.sleep(0)", r"    node.get_logger().info('5 \u00b5m, \udc80')"
        )
        with project_of(tmp_path, says).session() as s:
            s.step()
        assert "5 µm, \\udc80" in s.close().log("a")

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

    def test_the_current_folder_may_be_removed(self, tmp_path: Path) -> None:
        project = project_of(tmp_path, LOOKS_AT_ITS_PLACE)
        with project.session(output=tmp_path / "run") as s:
            s.step()
            gone = tmp_path / "gone"
            gone.mkdir()
            os.chdir(gone)
            gone.rmdir()
            s.step()
            assert s["a.x"].count == 2
            os.chdir(tmp_path)
            s.step()
            assert Path.cwd() == tmp_path

    def test_sessions_in_threads_have_the_process_in_turn(self, tmp_path: Path) -> None:
        project = project_of(tmp_path, LOOKS_AT_ITS_PLACE)

        def run(_: int) -> int:
            with project.session() as s:
                for _ in range(20):
                    s.step()
                return s["a.x"].count

        with ThreadPoolExecutor(3) as threads:
            assert [*threads.map(run, range(6))] == [20] * 6
        assert Path.cwd() == tmp_path
        assert "NEUROS_RUN_DIR" not in os.environ
        assert len([*(tmp_path / "runs").rglob("run.json")]) == 6

    def test_a_long_time_out_is_one(self, tmp_path: Path, back_end: str) -> None:
        with project_of(tmp_path, LOOKS_AT_ITS_PLACE).session(backend=back_end) as s:
            assert s.step(timeout_s=1e300)
            assert s["a.x"].wait(1e300) is not None

    def test_a_step_waits_for_another_session_no_longer_than_it_may_take(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        runs, may_end = threading.Event(), threading.Event()

        def hold(_: Session) -> None:
            runs.set()
            may_end.wait(DEADLINE_S)

        (tmp_path / "other").mkdir()
        with (
            project_of(tmp_path / "other", LOOKS_AT_ITS_PLACE).session() as s,
            using(tmp_path, monkeypatch, hold) as holding,
            ThreadPoolExecutor(1) as thread,
        ):
            holds = thread.submit(holding.step)
            runs.wait(DEADLINE_S)
            with pytest.raises(TimeoutError, match="a hook of another session"):
                s.step(timeout_s=0.01)
            may_end.set()
            assert holds.result(DEADLINE_S)
            assert s.step(timeout_s=DEADLINE_S)

    def test_a_hook_may_step_another_session(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "inner").mkdir()
        with (
            project_of(tmp_path / "inner", LOOKS_AT_ITS_PLACE).session() as inner,
            using(tmp_path, monkeypatch, lambda _: inner.step()) as s,
        ):
            s.step(2)
            assert inner["a.x"].count == 2
        assert s.close().exit_code == 0

    @pytest.mark.parametrize("call", ["step", "reset", "close"])
    def test_a_hook_cannot_use_the_session_that_runs_it(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
    ) -> None:
        with using(tmp_path, monkeypatch, lambda s: getattr(s, call)()) as s:
            with pytest.raises(RunError, match=r"hook 'use': .*a hook of this session runs"):
                s.step()
            assert Path.cwd() == tmp_path
        assert s.close().exit_code == 1

    def test_nest_is_of_one_session_and_of_its_nodes_that_import_it(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        nest, resets = ModuleType("nest"), []
        nest.ResetKernel = lambda: resets.append(1)  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "nest", nest)  # the program had it before
        for name in ("plain", "brain"):
            (tmp_path / name).mkdir()
        plain = project_of(tmp_path / "plain", LOOKS_AT_ITS_PLACE)
        brain = project_of(tmp_path / "brain", USES_NEST)
        (tmp_path / "brain" / "helper.py").write_text("import nest")
        for _ in range(2):
            with plain.session() as s, brain.session() as user:
                with pytest.raises(UsageError, match="NEST has one kernel per process"):
                    brain.session()
                for each in (s, user):
                    each.reset()
                    each.step()
                assert (len(s.runs), len(user.runs)) == (0, 1)
        assert len(resets) == 4

    def test_until_may_reset_and_close_the_session(self, tmp_path: Path) -> None:
        with project_of(tmp_path, LOOKS_AT_ITS_PLACE).session() as s:
            s.step(3)
            resets = iter([s.reset])
            assert s.step(until=lambda s: next(resets, lambda: None)() or s["a.x"].count == 2)
            assert s["a.x"].count == 2
            assert not s.step(until=lambda s: s.close())


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

    def test_ctrl_c_waits_for_the_hook_and_the_program_may_go_on(
        self, tmp_path: Path, ctrl_c: None
    ) -> None:
        with project_of(tmp_path, INTERRUPTED).session() as s:
            s.step()
            with pytest.raises(KeyboardInterrupt):
                s.step()
            s.step()
            assert [packet.data for packet in s["a.x"].packets] == [0.0, 1.0, 2.0]
        assert s.close().exit_code == 0

    def test_ctrl_c_waits_for_the_hook_of_each_session(self, tmp_path: Path, ctrl_c: None) -> None:
        (tmp_path / "other").mkdir()
        with (
            project_of(tmp_path / "other", LOOKS_AT_ITS_PLACE).session() as other,
            project_of(tmp_path, INTERRUPTS, environment={"AT": "work"}).session() as s,
        ):
            for between in (other.step, other.close):
                between()
                with pytest.raises(KeyboardInterrupt):
                    s.step()
        assert s.close().exit_code == 0
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler

    def test_ctrl_c_in_a_reset_ends_the_run_and_the_next_reset_begins_another(
        self, tmp_path: Path, ctrl_c: None
    ) -> None:
        with project_of(tmp_path, INTERRUPTS, environment={"AT": ""}).session() as s:
            s.step(5)
            assert s["a.x"].count == 5
            with pytest.raises(KeyboardInterrupt):
                s.reset(set={"nodes.a.environment.AT": "start"})
            with pytest.raises(RunError, match=r"ended by Ctrl\+C"):
                s.step()
            s.reset()
            s.step(2)
            assert s["a.x"].count == 2
        assert [run.exit_code for run in s.runs] == [130]

    def test_a_record_that_cannot_be_written_is_the_reason_of_the_end(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
        with project_of(tmp_path, LOOKS_AT_ITS_PLACE).session() as s:
            s.step(2)
            (s.folder / "run.json").mkdir()
        run = s.close()
        assert run.exit_code == 4
        assert re.search(r"run\.json cannot be written .*: it is in .* instead", run.reason)
        assert [*tmp_path.glob("neuros-*/run.json")]

    def test_a_run_folder_that_is_removed_is_a_fault_of_the_run(self, tmp_path: Path) -> None:
        with project_of(tmp_path, LOOKS_AT_ITS_PLACE).session() as s:
            shutil.rmtree(s.folder)
        assert s.close().exit_code == 4
        assert str(s.folder) in s.close().reason

    def test_a_block_that_fails_ends_a_step_in_another_thread(self, tmp_path: Path) -> None:
        async def give_up() -> Session:
            with (
                contextlib.suppress(asyncio.TimeoutError),
                project_of(tmp_path, LOOKS_AT_ITS_PLACE).session() as s,
            ):
                await asyncio.wait_for(s.astep(until=lambda s: False), 0.05)
            return s

        assert asyncio.run(give_up()).close().reason == "the program failed: TimeoutError"
        assert Path.cwd() == tmp_path

    def test_a_plugin_with_a_thread_takes_a_new_run_at_a_reset(self, tmp_path: Path) -> None:
        project = project_of(tmp_path, SENDS_FROM_A_THREAD)
        threads = threading.active_count()
        with project.session() as s:
            s.step(until=lambda s: s["a.x"].count >= 3)
            s.reset()
            s.step(until=lambda s: s["a.x"].count >= 3)
            packets = [packet.data for packet in s["a.x"].packets]
            assert packets == [*range(1, len(packets) + 1)]
            assert len(s.runs) == 1
        wait_until(lambda: threading.active_count() <= threads, DEADLINE_S)

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

    def test_ros_is_served_while_a_run_that_goes_freely_is_busy(self, tmp_path: Path) -> None:
        with project_of(tmp_path, HEARS_ITSELF).session() as s:

            def is_heard() -> bool:
                s.run(duration_s=0.05)
                return bool(s["a.x"].packet.data)

            wait_until(is_heard, DEADLINE_S)

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

    def test_large_packets_have_64_mb(self, tmp_path: Path) -> None:
        outputs = [{"name": "x", "type": "sensor_msgs/msg/Image"}]
        with project_of(tmp_path, SENDS_PICTURES, outputs=outputs).session() as s:
            for _ in range(70):
                s.step()
                assert s["a.x"].packet is not None
            assert s["a.x"].dropped == 70 - 63
            with pytest.warns(UserWarning, match=r"a\.x: 7 packets were dropped"):
                assert len(s["a.x"].packets) == 63

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
