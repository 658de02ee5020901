"""Sessions: a program holds a run, steps it, reads its outputs and feeds its inputs."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from api_projects import ENDLESS, THROWER, dice
from cart_project import BRAIN, cart, port
from deadlines import wait_until
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import is_alive
from std_msgs.msg import Float64, String, UInt8MultiArray
from test_python_api import thrown

import neuros
from containers import require_containers
from neuros.api.live import LiveRun
from neuros.api.session import Session
from neuros.backends.control_sockets import connect
from neuros.cli.main import main
from neuros.control import (
    TO_OBSERVERS,
    Advance,
    Deliver,
    LogRecord,
    Watch,
)
from neuros.control.link import ControlLink
from neuros.errors import ProjectError, RunError, UsageError

ACCEPTANCE = pytest.mark.acceptance
EVERY_BACK_END = [
    "local",
    "in-process",
    pytest.param("process", marks=ACCEPTANCE),
    pytest.param("docker", marks=ACCEPTANCE),
]
DEADLINE_S = 60.0
EYES = "thrower.eyes"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "python.md"

ECHO = """
import time
from neuros.hooks import neuros_function, Optional

@neuros_function(inputs=Optional("image"), outputs="image")
def look(node, image):
    while not (node.run_dir / "go").exists():
        time.sleep(0.05)
    if image is None:
        image = node.make_packet("image")
        image.data = bytes(1_000_000)
    return image
"""
EYE = """
from neuros.hooks import neuros_tick

@neuros_tick(seconds=1.0, outputs="image")
def look(node):
    image = node.make_packet("image")
    image.data = bytes(4_000_000)
    return image
"""
ALARM = """
from neuros.hooks import neuros_tick

@neuros_tick(seconds=0.05)
def look(node):
    with open(node.run_dir / "looks", "a") as looks:
        looks.write("x")
"""
SEER = """
from neuros.hooks import Optional, neuros_function

@neuros_function(inputs=[Optional("image"), Optional("command")], outputs="seen")
def see(node, image, command):
    seen = node.make_packet("seen")
    seen.data = -1.0 if command is None or image is None else command.data
    return seen
"""
LEAPS = """
from neuros.hooks import neuros_function

@neuros_function(outputs="clock")
def step(node):
    rounds = (node.get_user_data() or 0) + 1
    node.set_user_data(rounds)
    clock = node.make_packet("clock")
    if rounds > 30:  # of 1 ms each
        clock.clock.sec, rounds = 100 * (rounds - 30), 30
    clock.clock.nanosec = rounds * 1_000_000
    return clock
"""
PLAYER = """
from neuros.hooks import neuros_function, neuros_initialise, Optional

@neuros_initialise(outputs=Optional("ball"))
def serve(node):
    return node.make_packet("ball") if node.name == "left" else None

@neuros_function(inputs="ball", outputs="ball")
def play(node, ball):
    return ball
"""
REFEREE = """
from neuros.hooks import neuros_tick

@neuros_tick(seconds=0.01)
def watch(node):
    pass
"""
READINGS = """
from neuros.hooks import neuros_function

@neuros_function(outputs="clock")
def step(node):
    # To the next reading of joints (50 Hz) or of a camera (30 Hz); a second has 300 parts.
    part = (node.get_user_data() or 0) + 1
    while part % 6 and part % 10:
        part += 1
    node.set_user_data(part)
    clock = node.make_packet("clock")
    clock.clock.sec, clock.clock.nanosec = divmod(part * 10**9 // 300, 10**9)
    return clock
"""


def pondering_cart(folder: Path) -> Path:
    """The cart with a brain that decides nothing until there is a file ``go`` in its folder."""
    made = cart(folder)
    waits = """
    while not (node.run_dir / "go").exists():
        time.sleep(0.05)
"""
    head = "def decide(node, pose):\n"
    brain = BRAIN.replace(head, head + waits.lstrip("\n"))
    (made / "brain.py").write_text(f"import time\n{brain}")
    return made


def eye(folder: Path, plugin: str) -> Path:
    """A node that has the time of a simulator."""
    clock = [port("clock", "rosgraph_msgs/msg/Clock")]
    node = {"name": "eye", "plugin": "eye.py", "container": "neuros_python", "outputs": clock}
    (folder / "eye.py").write_text(plugin)
    (folder / "project.json").write_text(json.dumps({"nodes": [node]}))
    return folder


def rally(folder: Path) -> Path:
    """Two players and a ball between them that a referee watches by the clock: it never rests."""
    (folder / "player.py").write_text(PLAYER)
    (folder / "referee.py").write_text(REFEREE)
    ball = [port("ball")]
    players = {"left": [port("ball"), port("wind")], "right": ball}
    nodes: list[dict[str, Any]] = [
        {"name": name, "plugin": "player.py", "inputs": inputs, "outputs": ball}
        for name, inputs in players.items()
    ]
    nodes.append({"name": "referee", "plugin": "referee.py"})
    ends = ("left", "right"), ("right", "left")
    keys = ("source_node", "source_output", "destination_node", "destination_input")
    project = {
        "nodes": [{**node, "container": "neuros_python"} for node in nodes],
        "connections": [
            {**dict(zip(keys, (a, "ball", b, "ball"), strict=True)), "discard_limit": 0}
            for a, b in ends
        ],
    }
    (folder / "project.json").write_text(json.dumps(project))
    return folder


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


@pytest.fixture(scope="module", params=["local", "in-process"])
def held(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Iterator[Session]:
    """A session whose steps no test counts from the start."""
    folder = tmp_path_factory.mktemp("held")
    project = neuros.Project.from_file(cart(folder))
    with project.session(backend=request.param, output=folder / "run") as s:
        yield s


@contextlib.contextmanager
def ended_at_the_deadline(s: Session) -> Iterator[None]:
    """Whatever hangs in there fails instead, since the run is interrupted."""
    timer = threading.Timer(DEADLINE_S, s._held.interrupt, ("it hangs", 1))
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def poses(s: Session, rounds: int) -> list[float]:
    """Where the robot is after each round."""
    found = []
    for _ in range(rounds):
        assert s.step(timeout_s=DEADLINE_S)
        found.append(s["robot.pose"].packet.data)
    return found


# ------------------------------------------------------------------ steps


@pytest.mark.parametrize("back_end", EVERY_BACK_END)
class TestOnEveryBackEnd:
    def test_a_round_is_one_start_of_what_drives_and_all_answers(
        self, tmp_path: Path, back_end: str
    ) -> None:
        if back_end == "docker":
            require_containers()
        with neuros.Project.from_file(cart(tmp_path)).session(backend=back_end) as s:
            assert s["robot.pose"].packet is None
            assert poses(s, 3) == [1.0, 0.5, 0.25]
            assert s["brain.command"].packet == Float64(data=-0.125)
            s.send("robot.push", Float64(data=8.0))
            assert poses(s, 1) == [8.125]
            assert s.step(sim_s=0.04, timeout_s=DEADLINE_S)
            assert s["robot.pose"].count == 8
            assert s.sim_time == pytest.approx(0.08)
            assert s.step(until=lambda s: s["robot.pose"].packet.data < 0.01)
        run = s.close()
        assert (run.exit_code, run.reason) == (0, "the session was closed")
        # What was under way at the end may still have been answered.
        assert run.connections["robot.pose -> brain.pose"]["lost"] == 0

    def test_a_connection_is_taken_over(self, tmp_path: Path, back_end: str) -> None:
        if back_end == "docker":
            require_containers()
        project = neuros.Project.from_file(cart(tmp_path))
        with project.session(backend=back_end, take_over="robot.wheels") as s:
            assert poses(s, 2) == [1.0, 1.0]
            s.send("robot.wheels", Float64(data=2.0))
            assert poses(s, 2) == [3.0, 3.0]
            assert s["brain.command"].count == 4
            s.send("robot.wheels", Float64(data=13.0))
            with pytest.raises(RunError, match=r"(?s)robot\.py:\d+.*a wheel has broken"):
                s.step(timeout_s=DEADLINE_S)
            with pytest.raises(RunError, match="a wheel has broken"):
                s.step()
        assert s.close().exit_code == 1

    def test_rounds_by_hand_give_the_packets_of_a_free_run(
        self, tmp_path: Path, back_end: str
    ) -> None:
        if back_end == "docker":
            require_containers()
        project = neuros.Project.from_file(dice(tmp_path, ENDLESS))
        with project.session(backend=back_end, seed=3) as s:
            shown = []
            for _ in range(10):
                s.step(timeout_s=DEADLINE_S)
                shown.append(s["thrower.eyes"].packet.data)
        assert shown == thrown(3)


@pytest.mark.acceptance
@settings(max_examples=2)
@given(parts=st.lists(st.integers(1, 9), min_size=1, max_size=6), seed=st.integers(0, 99))
@pytest.mark.parametrize("back_end", ["in-process", "process"])
def test_however_rounds_are_put_together_the_recorded_packets_are_those_of_a_free_run(
    tmp_path_factory: pytest.TempPathFactory, back_end: str, parts: list[int], seed: int
) -> None:
    folder = tmp_path_factory.mktemp("parts")
    project = neuros.Project.from_file(dice(folder, ENDLESS.replace("== 0", "== 60")))
    free = project.run(backend=back_end, seed=seed, record=True, output=folder / "free").check()
    with project.session(backend=back_end, seed=seed, record=True, output=folder / "held") as s:
        for rounds in parts:
            s.step(rounds)
        assert s["thrower.eyes"].count == sum(parts)
    stepped, whole = ([m.data for _, m in run.bag[EYES].messages()] for run in (s.close(), free))
    assert stepped == whole[: len(stepped)]
    assert len(stepped) >= sum(parts)


@pytest.mark.acceptance
@pytest.mark.parametrize("back_end", ["in-process", "process", "docker"])
def test_what_is_stepped_to_its_end_is_verified_against_a_free_run(
    tmp_path: Path, back_end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if back_end == "docker":
        require_containers()
    made = dice(tmp_path, ENDLESS)
    last = 'THROWN.append(packet.data)\n    if len(THROWN) == 60:\n        node.shutdown("thrown")'
    thrower = THROWER.replace("    return packet", f"    {last}\n    return packet")
    (made / "thrower.py").write_text(f"THROWN = []\n{thrower}")
    project = neuros.Project.from_file(made)
    free = project.run(backend="process", seed=3, output=tmp_path / "free").check()
    held = tmp_path / "held"
    with project.session(backend=back_end, seed=3, digests=True, output=held) as s:
        while s.step(timeout_s=DEADLINE_S):
            pass
    assert s.close().exit_code == 0
    capsys.readouterr()
    assert main(["verify", str(free.folder), str(held)]) == 0
    assert "identical" in capsys.readouterr().out


def observer_of(live: LiveRun) -> ControlLink:
    """An observer, as soon as the run can be observed."""
    deadline_s = time.monotonic() + DEADLINE_S
    while True:
        try:
            link = ControlLink(connect(live.control_address), TO_OBSERVERS, "the supervisor")
        except OSError:
            assert time.monotonic() < deadline_s
        else:
            link.send(Watch())
            return link


def refusals(live: LiveRun, node_log: Path, *wrong: Deliver) -> str:
    """What is said of wrong packets, each of an observer of its own."""
    heard: list[str] = []
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(contextlib.closing(observer_of(live)))
        listener.stream.setblocking(False)

        def is_refused(packet: Deliver) -> bool:
            heard.extend(m.text for m in listener.receive() or () if isinstance(m, LogRecord))
            is_told = any(f"'{packet.node}.{packet.input}'" in text for text in heard)
            return is_told or f"input '{packet.input}' is refused" in node_log.read_text("utf-8")

        for packet in wrong:
            stack.enter_context(contextlib.closing(observer_of(live))).send(packet)
            wait_until(lambda packet=packet: is_refused(packet), DEADLINE_S)
    return "\n".join([*heard, node_log.read_text("utf-8")])


@pytest.mark.parametrize(
    ("input_name", "data", "reason"),
    [
        ("nothing", b"abc", "a packet came for 'robot.nothing', no session's input"),
        ("wheels", b"abc", "a packet came for 'robot.wheels', no session's input"),
        ("push", b"abc", "input 'push' is refused: 3 bytes are not a std_msgs/Float64"),
    ],
)
@pytest.mark.parametrize("back_end", ["in-process", "process"])
def test_a_wrong_packet_of_an_observer_is_refused_and_the_session_goes_on(
    tmp_path: Path, back_end: str, input_name: str, data: bytes, reason: str
) -> None:
    with neuros.Project.from_file(cart(tmp_path)).session(backend=back_end) as s:
        log = s.folder / "robot" / "node.log"
        assert reason in refusals(s._held._live, log, Deliver("robot", input_name, data))
        assert poses(s, 2) == [1.0, 0.5]
    assert s.close().exit_code == 0
    assert "Traceback" not in log.read_text("utf-8")


@pytest.mark.filterwarnings("ignore:.*'(push|clock)' of node 'robot' is not connected")
@pytest.mark.parametrize("back_end", ["in-process", "process"])
def test_in_a_run_that_is_no_session_every_packet_of_an_observer_is_refused(
    tmp_path: Path, back_end: str
) -> None:
    live = neuros.Project.from_file(cart(tmp_path)).start(backend=back_end)
    log = live.folder / "robot" / "node.log"
    wait_until(log.exists, DEADLINE_S)
    names = ("push", "wheels", "nothing")
    told = refusals(live, log, *(Deliver("robot", name, bytes(8)) for name in names))
    assert all(f"a packet came for 'robot.{name}', no session's input" in told for name in names)
    live.stop("enough")
    assert live.wait(DEADLINE_S).exit_code == 0


def test_what_is_sent_before_a_free_run_arrives_before_it(tmp_path: Path) -> None:
    project = neuros.Project.from_file(cart(tmp_path))
    with project.session(backend="in-process", take_over="robot.wheels") as s:
        s.send("robot.push", Float64(data=8.0))
        s.run(duration_sim_s=0.01)
        assert s["robot.pose"].packet.data == 9.0
        s.send("robot.push", Float64(data=8.0))
        deadline_s = time.monotonic() + DEADLINE_S
        while s["robot.pose"].count == 1:
            assert time.monotonic() < deadline_s
            s.run(duration_s=0.01)
        assert s["robot.pose"].packet.data == 17.0


def test_of_many_packets_sent_at_once_the_newest_are_kept(tmp_path: Path) -> None:
    with neuros.Project.from_file(cart(tmp_path)).session(backend="in-process") as s:
        for number in range(200):
            s.send("robot.push", Float64(data=float(number)))
        assert poses(s, 1) == [191.0]
        counters = s.state()["robot"].counters
    assert counters is not None
    push = counters.metrics["incoming"]["/neuros/session/robot/push -> robot.push"]
    assert (push["received"], push["discarded"], push["unread"]) == (200, 190, 9)
    assert not list(s.folder.glob("*.sock"))


def test_between_two_steps_nothing_starts(held: Session) -> None:
    """Not even a hook that would answer what is sent."""
    held.step()
    before = held["robot.pose"].count
    held.send("robot.push", Float64(data=0.5))
    counters = held.state()["robot"].counters
    assert counters is not None
    assert held["robot.pose"].count == before
    assert counters.metrics["incoming"]["/neuros/session/robot/push -> robot.push"]["unread"] == 1
    held.step()
    assert held["robot.pose"].count == before + 1


def test_a_free_run_ends_where_simulated_time_is_over(held: Session) -> None:
    held.step()
    assert held.sim_time is not None
    end_s = held.sim_time + 1.0
    assert held.run(duration_sim_s=1.0)
    assert held.sim_time == pytest.approx(end_s)


@pytest.mark.parametrize("back_end", ["in-process", "process"])
def test_a_free_run_ends_on_time_where_rounds_gain_different_times(
    tmp_path: Path, back_end: str
) -> None:
    with neuros.Project.from_file(eye(tmp_path, READINGS)).session(backend=back_end) as s:
        for rounds in range(1, 8):
            s.step(rounds, timeout_s=DEADLINE_S)
            assert s.sim_time is not None
            end_s = s.sim_time + 1.0
            assert s.run(duration_sim_s=1.0)
            assert s.sim_time == pytest.approx(end_s)


def test_in_one_thread_no_round_of_a_free_run_begins_after_its_end(tmp_path: Path) -> None:
    with neuros.Project.from_file(eye(tmp_path, LEAPS)).session(backend="local") as s:
        assert s.run(duration_sim_s=2.0)
        assert s.sim_time == pytest.approx(100.03)


def test_a_free_run_of_wall_time_is_held_again(held: Session) -> None:
    held.step()
    before = held["robot.pose"].count
    while (after := held["robot.pose"].count) == before:
        assert held.run(duration_s=0.1)
    held.step()
    assert held["robot.pose"].count == after + 1


def test_to_wait_for_a_packet_is_to_step(held: Session) -> None:
    before = held["brain.command"].count
    assert isinstance(held["brain.command"].wait(DEADLINE_S), Float64)
    assert held["brain.command"].count == before + 1


def test_a_coroutine_steps(held: Session) -> None:
    before = held["robot.pose"].count
    assert asyncio.run(held.astep(2))
    assert held["robot.pose"].count == before + 2


def test_a_notebook_shows_the_graph_and_the_hooks(held: Session) -> None:
    shown = held._repr_html_()
    assert "<svg" in shown
    assert "<td>decide</td>" in shown


def test_a_step_that_takes_too_long_is_waited_for_by_the_next(tmp_path: Path) -> None:
    with neuros.Project.from_file(cart(tmp_path)).session(backend="in-process") as s:
        children = psutil.Process().children(recursive=True)
        nodes = [each for each in children if str(s.folder) in " ".join(each.cmdline())]
        before = s["robot.pose"].count
        for node in nodes:
            node.suspend()
        try:
            with pytest.raises(TimeoutError, match="has not come to rest in time"):
                s.step(timeout_s=0.1)
        finally:
            for node in nodes:
                node.resume()
        s.step(timeout_s=DEADLINE_S)
        assert s["robot.pose"].count == before + 2


def test_a_step_that_another_question_has_overtaken_does_not_keep_the_next_one_from_being_heard(
    tmp_path: Path,
) -> None:
    with neuros.Project.from_file(pondering_cart(tmp_path)).session(backend="in-process") as s:
        assert s["robot.pose"].count == 0
        with pytest.raises(TimeoutError):
            s.step(timeout_s=0.5)
        s._held._supervisor.send(Advance(10_000, 0, {}))
        (s.folder / "brain" / "go").touch()
        s.step(timeout_s=DEADLINE_S)
        assert s["robot.pose"].count == 2


@pytest.mark.parametrize("back_end", ["in-process", "process"])
def test_after_a_step_that_took_too_long_a_large_packet_and_a_large_answer_pass_each_other(
    tmp_path: Path, back_end: str
) -> None:
    """Each is larger than the buffers between them: who only writes waits for who only writes."""
    images = [port("image", "std_msgs/msg/UInt8MultiArray")]
    brain = {"name": "brain", "plugin": "brain.py", "container": "neuros_python"}
    (tmp_path / "brain.py").write_text(ECHO)
    nodes = [{**brain, "inputs": images, "outputs": images}]
    (tmp_path / "project.json").write_text(json.dumps({"nodes": nodes}))
    project = neuros.Project.from_file(tmp_path)
    with project.session(backend=back_end) as s, ended_at_the_deadline(s):
        assert s["brain.image"].count == 0
        with pytest.raises(TimeoutError):
            s.step(timeout_s=0.1)
        s.send("brain.image", UInt8MultiArray(data=b"\1" * 1_000_000))
        (s.folder / "brain" / "go").touch()
        assert s.step(timeout_s=DEADLINE_S)
        assert s["brain.image"].count == 2
        assert s["brain.image"].packet.data[-1] == 1


@pytest.mark.parametrize("back_end", ["local", "in-process", "process"])
def test_a_round_that_never_ends_hinders_nothing_but_steps(tmp_path: Path, back_end: str) -> None:
    project = neuros.Project.from_file(rally(tmp_path))
    with project.session(backend=back_end) as s, ended_at_the_deadline(s):
        for _ in range(2):
            with pytest.raises(TimeoutError):
                s.step(timeout_s=0.2)
        counters = s.state()["left"].counters
        assert counters is not None
        assert counters.metrics["hooks"]["play"]["executions"] > 1
        for number in range(100):
            s.send("left.wind", Float64(data=float(number)))
        assert s.run(duration_s=0.1)
        before = s["left.ball"].count
        assert s.run(duration_s=0.1)
        assert s["left.ball"].count > before
        with pytest.raises(TimeoutError):
            s.step(timeout_s=0.2)
        for _ in range(2):
            with pytest.raises(TimeoutError, match="has not come to rest in time"):
                _ = s["right.ball"].count
        assert repr(s["right.ball"]).startswith("<right.ball: an unknown number of packets of")
        s.reset()
        assert s["left.ball"].count == 1


@pytest.mark.parametrize(
    "look",
    [
        lambda s: s.step(until=lambda _: s["brain.command"].count > 0),
        lambda s: s["brain.command"].wait(),
        lambda s: s["brain.command"].wait(timeout_s=DEADLINE_S),
    ],
)
def test_after_a_step_that_took_too_long_who_waits_for_an_output_waits_for_the_round(
    tmp_path: Path, look: Callable[[Session], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long it takes, unlike who only looks."""
    monkeypatch.setattr("neuros.api.session._READ_S", 0.0)
    with neuros.Project.from_file(pondering_cart(tmp_path)).session(backend="in-process") as s:
        with pytest.raises(TimeoutError):
            s.step(timeout_s=0.1)
        with pytest.raises(TimeoutError):
            _ = s["brain.command"].packet
        timer = threading.Timer(0.5, (s.folder / "brain" / "go").touch)
        timer.start()
        assert look(s)
        timer.join()


def test_a_program_that_does_not_read_a_large_answer_does_not_keep_the_run_from_ending(
    tmp_path: Path,
) -> None:
    eye: dict[str, Any] = {"name": "eye", "plugin": "eye.py", "container": "neuros_python"}
    eye["outputs"] = [port("image", "std_msgs/msg/UInt8MultiArray")]
    (tmp_path / "eye.py").write_text(EYE)
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [eye]}))
    with neuros.Project.from_file(tmp_path).session(backend="in-process") as s:
        assert s["eye.image"].count == 0
        children = psutil.Process().children(recursive=True)
        (node,) = (each for each in children if str(s.folder) in " ".join(each.cmdline()))
        node.suspend()
        try:
            with pytest.raises(TimeoutError):
                s.step(timeout_s=0.0)
        finally:
            node.resume()
        assert select.select([s._held._supervisor], [], [], DEADLINE_S)[0]
        s._held._live.interrupt()
        run = s._held._live.wait(DEADLINE_S)
    assert run.exit_code == 130
    assert run.nodes["eye"]["report"] == "final"


@pytest.mark.parametrize("backend", ["local", "in-process", "process"])
def test_packets_that_are_sent_at_once_are_all_there_however_large(
    tmp_path: Path, backend: str
) -> None:
    inputs = [port("image", "std_msgs/msg/UInt8MultiArray"), port("command")]
    seer = {"name": "seer", "plugin": "seer.py", "container": "neuros_python"}
    (tmp_path / "seer.py").write_text(SEER)
    nodes = [{**seer, "inputs": inputs, "outputs": [port("seen")]}]
    (tmp_path / "project.json").write_text(json.dumps({"nodes": nodes}))
    found = []
    with neuros.Project.from_file(tmp_path).session(backend=backend) as s:
        for number in range(5):
            s.send("seer.image", UInt8MultiArray(data=bytes(2_000_000)))
            s.send("seer.command", Float64(data=float(number)))
            s.step(timeout_s=DEADLINE_S)
            found.append(s["seer.seen"].packet.data)
    assert found == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_the_program_is_interrupted_in_a_step_and_goes_on(held: Session) -> None:
    def interrupt(_: Session) -> bool:
        signal.raise_signal(signal.SIGINT)
        return False

    before = held["robot.pose"].count
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            held.step(until=interrupt)
    finally:
        signal.signal(signal.SIGINT, handler)
    held.step(timeout_s=DEADLINE_S)
    assert held["robot.pose"].count == before + 1


def test_the_code_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(cart(tmp_path))
    _, _, section = PAGE.read_text("utf-8").partition("\n## Sessions\n")
    (code,) = re.findall(r"```python\n(.*?)```", section.partition("\n### ")[0], re.DOTALL)
    exec(compile(code, str(PAGE), "exec"), {})
    assert "0 the session was closed" in capsys.readouterr().out


# ------------------------------------------------------------------ mistakes


def test_an_unknown_name_is_said_with_its_place(held: Session) -> None:
    with pytest.raises(UsageError, match=r"did you mean 'pose'\?.*project\.json:3:\d+"):
        held["robot.poze"]
    with pytest.raises(UsageError, match=r"no node 'robt' \(did you mean 'robot'\?\)"):
        held["robt.pose"]
    with pytest.raises(UsageError, match="no such input"):
        held.send("robot.pose", Float64())


def test_an_input_that_a_connection_feeds_is_refused(held: Session) -> None:
    with pytest.raises(UsageError, match=r"brain\.command -> robot\.wheels.*take_over"):
        held.send("robot.wheels", Float64())


def test_wrong_values_are_refused_as_those_of_a_hook(held: Session) -> None:
    with pytest.raises(TypeError, match="input 'push' takes std_msgs/msg/Float64"):
        held.send("robot.push", String(data="13"))
    wrong = Float64()
    wrong._data = "13"
    with pytest.raises(ValueError, match="packet for input 'push': field 'data' must be"):
        held.send("robot.push", wrong)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda s: s.step(-1), "rounds=-1: give 0 or more"),
        (lambda s: s.step(sim_s=-0.1), "sim_s=-0.1: give 0 or more seconds"),
        (lambda s: s.step(sim_s=float("nan")), "sim_s=nan: give 0 or more seconds"),
        (lambda s: s.run(duration_s=-1), "duration_s=-1: give 0 or more seconds"),
        (lambda s: s.run(duration_sim_s=float("inf")), "duration_sim_s=inf: give 0 or more"),
        (lambda s: s.step(3, sim_s=0.1), "rounds and sim_s are lengths of one step: give one"),
        (lambda s: s.step(until=bool, sim_s=1), "sim_s and until are lengths of one step"),
        (lambda s: s.step(2.5), "rounds=2.5: give a whole number"),
        (lambda s: s.step("2"), "rounds='2': give a whole number"),
        (lambda s: s.step(True), "rounds=True: give 0 or more"),
        (lambda s: s.step(until=True), "until=True: give a function that takes the session"),
        (lambda s: s.step(sim_s="1"), "sim_s='1': give 0 or more seconds"),
        (lambda s: s["robot"], "'robot' is a node: name one of its outputs, which are robot.pose"),
    ],
)
def test_a_length_that_is_none_is_refused(
    held: Session, call: Callable[[Session], object], said: str
) -> None:
    before = held["robot.pose"].count
    with pytest.raises(UsageError, match=re.escape(said)):
        call(held)
    assert held["robot.pose"].count == before


def test_what_a_session_cannot_be_is_said_before_anything_starts(tmp_path: Path) -> None:
    project = neuros.Project.from_file(cart(tmp_path))
    with pytest.raises(TypeError, match=r"Project.session\(\) got an unexpected keyword.*'nodes'"):
        project.session(nodes=["robot"])
    with pytest.raises(UsageError, match=r"did you mean 'wheels'\?"):
        project.session(take_over="robot.wheel")
    assert not (tmp_path / "runs").exists()
    with pytest.raises(ProjectError):
        project.session(set={"nodes.robot.plugin": "nothing.py"})


def test_simulated_seconds_need_a_node_that_has_them(tmp_path: Path) -> None:
    project = neuros.Project.from_file(dice(tmp_path))
    with project.session(backend="in-process") as s:
        with pytest.raises(UsageError, match="no node of dice owns simulated time"):
            s.step(sim_s=1.0)
        # And a project that ends itself ends the session.
        assert not s.step(20)
    assert s.close().reason == "counter ended the project: ten were thrown"
    with pytest.raises(RunError, match="ten were thrown"):
        s.step()


# ------------------------------------------------------------------ its end


@pytest.mark.parametrize(
    ("error", "exit_code", "reason"),
    [
        (KeyError("gain"), 7, "the program failed: KeyError: 'gain'"),
        (AssertionError(), 7, "the program failed: AssertionError"),
        (KeyboardInterrupt(), 130, "ended by Ctrl+C"),
    ],
)
def test_a_block_that_fails_ends_the_run_and_is_the_reason(
    tmp_path: Path, error: BaseException, exit_code: int, reason: str
) -> None:
    project = neuros.Project.from_file(cart(tmp_path))
    s = project.session(backend="in-process")
    with pytest.raises(type(error)), s:
        raise error
    run = s.close()
    assert (run.exit_code, run.reason) == (exit_code, reason)
    with pytest.raises(RunError):
        run.check()


@pytest.mark.acceptance
def test_a_plugin_that_cannot_be_imported_is_the_error_of_the_start(tmp_path: Path) -> None:
    made = cart(tmp_path)
    (made / "brain.py").write_text(BRAIN + "\nraise ValueError('no brain')\n")
    with pytest.raises(RunError, match="no brain"):
        neuros.Project.from_file(made).session(backend="in-process")


@pytest.mark.acceptance
@pytest.mark.parametrize("back_end", ["in-process", "process"])
def test_a_program_that_is_killed_leaves_nothing(tmp_path: Path, back_end: str) -> None:
    program = (
        "import neuros, time\n"
        f"s = neuros.Project.from_file({str(cart(tmp_path))!r}).session(backend={back_end!r})\n"
        "s.step()\nprint('held', flush=True)\ntime.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        started = [child.pid for child in psutil.Process(process.pid).children(recursive=True)]
        assert started
        process.kill()
    wait_until(lambda: not any(map(is_alive, started)), DEADLINE_S)


def test_two_threads_share_a_session(held: Session) -> None:
    before = held["robot.pose"].count
    threads = [threading.Thread(target=held.step, args=(5,)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert held["robot.pose"].count == before + 10


TEST = """
def test_the_robot_comes_back(neuros_session):
    s = neuros_session("cart/project.json", backend="in-process")
    s.step(4)
    assert abs(s["robot.pose"].packet.data) < 0.2
"""


@pytest.mark.acceptance
def test_the_fixture_of_pytest_closes_its_sessions(tmp_path: Path) -> None:
    cart(tmp_path)
    (tmp_path / "test_cart.py").write_text(TEST)
    # Whether or not the plugin is known from the installation.
    plugin = ["-p", "no:neuros", "-p", "neuros.pytest_plugin", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *plugin, "test_cart.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
    )
    assert "1 passed" in done.stdout, done.stdout + done.stderr
    (run,) = (tmp_path / "runs" / "cart").iterdir()
    assert neuros.Run(run).reason == "the session was closed"
