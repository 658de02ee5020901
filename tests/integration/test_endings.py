"""However a project ends: the exit code, the last line, complete logs, and nothing left behind.

Real launchers, guardians and nodes on real rclpy, on both back ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from endings import GONE_WITHIN_S, RUNS, dead_shared_memory
from launching import BACKENDS, Finished, Running, launch, start

from containers import wait_until

MARK = "NEUROS_TEST_ENDING"
HEAD = """
import ctypes, os, signal, sys, threading, time
from neuros.hooks import (All, Optional, neuros_finalise, neuros_function, neuros_initialise,
                          neuros_tick)
def note(node, text):
    (node.run_dir / text).touch()
@neuros_finalise()
def save(node):
    note(node, "saved")
    node.get_logger().info("all is saved")
"""
ENDS = """
@neuros_tick(seconds=0.1)
def end(node):
    node.shutdown("enough")
"""
SOURCE = """
@neuros_tick(seconds=0.002, outputs="o")
def send(node):
    return node.make_packet("o")
"""
RELAY = """
@neuros_function(inputs="x", outputs="o")
def relay(node, x):
    return x
"""
SINK = """
@neuros_function(inputs="x")
def take(node, x):
    pass
"""
COUNTS = """
@neuros_function(inputs="x")
def count(node, x):
    node.set_user_data((node.get_user_data() or 0) + 1)
    if node.get_user_data() == 50:
        node.shutdown("enough")
"""


class Bench:
    """A folder in which a test writes its project and runs it."""

    def __init__(self, folder: Path, back_end: str) -> None:
        self.folder = folder
        self.back_end = back_end
        self.mark = uuid.uuid4().hex
        self.began_s = time.time()
        self.outputs: list[str] = []
        self.running: list[Running] = []

    def project(self, *connections: str | tuple[str, int | None], **plugins: str) -> Path:
        """Write a project; ``"a.out -> b.in"`` is lossless, ``(..., None)`` best effort."""
        wires = [c if isinstance(c, tuple) else (c, 0) for c in connections]
        ends = [(*re.split(r" -> |\.", wire), limit) for wire, limit in wires]
        for name, plugin in plugins.items():
            (self.folder / f"{name}.py").write_text(HEAD + plugin)
        nodes = [
            {
                "name": name,
                "container": "neuros_python",
                "plugin": f"{name}.py",
                "outputs": _ports(out for source, out, _, _, _ in ends if source == name),
                "inputs": _ports(
                    into for _, _, destination, into, _ in ends if destination == name
                ),
            }
            for name in plugins
        ]
        keys = ("source_node", "source_output", "destination_node", "destination_input")
        joined = [
            dict(zip(keys, end[:4], strict=True))
            | ({} if end[4] is None else {"discard_limit": end[4]})
            for end in ends
        ]
        file = self.folder / "project.json"
        file.write_text(json.dumps({"nodes": nodes, "connections": joined}))
        return file

    def launch(self, *arguments: str, timeout_s: float = 20.0) -> Finished:
        """Run the project to its end."""
        finished = launch(
            self.folder,
            *self._arguments(arguments),
            cwd=self.folder,
            timeout_s=timeout_s,
            **{MARK: self.mark},
        )
        self.outputs.append(finished.output)
        return finished

    def start(self, *arguments: str) -> Running:
        """Start it; it is ended with the test."""
        running = start(
            self.folder, *self._arguments(arguments), cwd=self.folder, **{MARK: self.mark}
        )
        self.running.append(running)
        return running

    def _arguments(self, arguments: Sequence[str]) -> Sequence[str]:
        return ("--backend", self.back_end, *arguments)

    def saved(self, *names: str) -> bool:
        """Whether the finalise hooks of these nodes have run, and logged that they have."""
        folders = {path.parent for path in self.folder.rglob("saved")}
        return {folder.name for folder in folders} == set(names) and all(
            "all is saved" in (folder / "node.log").read_text() for folder in folders
        )

    def pid_of(self, node: str) -> int:
        """The process that a node runs in."""
        for pid, environment, command in _processes():
            if f"{MARK}={self.mark}" in environment and f"/{node}/node.json" in command:
                return pid
        raise AssertionError(f"no process of {node}")

    def is_anything_left(self) -> str:
        """Names what is left of the runs, or nothing."""
        for pid, environment, command in _processes():
            if f"{MARK}={self.mark}" in environment:
                return f"process {pid}: {command}"
        for socket in self.folder.rglob("control.sock"):
            return str(socket)
        for domain in re.findall(r"ROS domain (\d+) \(first free", "".join(self.outputs)):
            if _is_stale(Path(f"/tmp/neuros-domain-{domain}.lock")):
                return f"the lock file of domain {domain}"
        return " ".join(dead_shared_memory(self.began_s))


def _ports(names: Iterator[str]) -> list[dict[str, str]]:
    return [{"name": name, "type": "std_msgs/msg/Int32"} for name in dict.fromkeys(names)]


def _processes() -> Iterator[tuple[int, list[str], str]]:
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            environment = (folder / "environ").read_bytes().decode(errors="replace").split("\0")
            command = (folder / "cmdline").read_bytes().decode(errors="replace")
            if environment != [""] or command:  # else it is a zombie
                yield int(folder.name), environment, command.replace("\0", " ").strip()


def _is_stale(lock: Path) -> bool:
    """Whether a lock file is there that nobody holds."""
    with contextlib.suppress(OSError), open(lock) as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    return False


@contextlib.contextmanager
def made_bench(folder: Path, back_end: str) -> Iterator[Bench]:
    """A bench; afterwards all that was started on it has ended, and left nothing."""
    bench = Bench(folder, back_end)
    try:
        yield bench
    finally:
        for running in bench.running:
            running.close()
            bench.outputs.append(running.output)
    deadline_s = time.monotonic() + GONE_WITHIN_S
    while (left := bench.is_anything_left()) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    assert not left


@pytest.fixture(params=BACKENDS)
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Bench]:
    with made_bench(tmp_path, request.param) as bench:
        yield bench


def last_line(finished: Finished) -> str:
    return finished.said("neuros")[-1]


def assert_ended(finished: Finished, exit_code: int, reason: str) -> None:
    """The exit code, and what is printed last and stands in ``run.json``."""
    assert finished.exit_code == exit_code, finished.output
    assert re.fullmatch(reason, last_line(finished)), finished.output
    assert finished.output.rstrip().endswith(last_line(finished))
    assert finished.record["exit_code"] == exit_code
    assert finished.record["reason"] == last_line(finished)


# ------------------------------------------------------------------ failures


FAILS = """
@neuros_tick(seconds=0.1, outputs=Optional("o"))
def divide(node):
    calculate()
def calculate():
    return 1 / 0
"""


def test_a_hook_that_fails_is_named_last_with_its_cause(bench: Bench) -> None:
    bench.project("a.o -> b.x", a=FAILS, b=SINK)
    finished = bench.launch()
    lines = (bench.folder / "a.py").read_text().splitlines()
    where = re.escape(f"{bench.folder / 'a.py'}:{lines.index('    return 1 / 0') + 1}")
    assert_ended(
        finished, 1, f"node 'a' failed: {where}: hook 'divide': ZeroDivisionError: .*by zero"
    )
    assert "Traceback (most recent call last)" in finished.output
    assert "in calculate" in finished.output
    assert bench.saved("a", "b")


def test_a_packet_that_cannot_be_sent_is_named_with_its_output_and_field(bench: Bench) -> None:
    fills = "    packet = node.make_packet('o')\n    packet.data = 'three'\n    return packet\n"
    bench.project(
        "a.o -> b.x",
        a=f"@neuros_tick(seconds=0.1, outputs='o')\ndef fill(node):\n{fills}",
        b=SINK,
    )
    finished = bench.launch("--digests")  # in process packets are serialised for these only
    what = r"packet for output 'o': field 'data' must be int32, but is 'three' \(str\)"
    assert_ended(finished, 1, f"node 'a' failed: .*a\\.py: {what}")
    assert "Traceback" not in finished.output


@pytest.mark.parametrize(
    ("plugin", "reason"),
    [
        ("import no_such_package", ".*/a.py: cannot be imported: ModuleNotFoundError: .*"),
        ("def broken(:", ".*/a.py:\\d+: cannot be imported: SyntaxError: .*"),
        ("raise SystemExit(0)", ".*/a.py: cannot be imported: SystemExit: 0"),
    ],
)
def test_a_plugin_that_cannot_be_imported_is_named_last(
    bench: Bench, plugin: str, reason: str
) -> None:
    bench.project(a=plugin, b=RUNS)
    finished = bench.launch()
    assert_ended(finished, 1, f"node 'a' failed: {reason}")
    assert "Traceback" in finished.output


def test_a_hook_that_calls_exit_has_failed(bench: Bench) -> None:
    bench.project(a="@neuros_tick(seconds=0.1)\ndef leave(node):\n    sys.exit(0)\n")
    assert_ended(bench.launch(), 1, "node 'a' failed: .*: hook 'leave': SystemExit: 0")
    assert bench.saved("a")


@pytest.mark.parametrize(
    ("act", "how"),
    [
        ("os._exit(0)", "exit code 0"),
        ("ctypes.string_at(0)", "killed by SIGSEGV"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "killed by SIGKILL"),
        ("os.kill(os.getpid(), signal.SIGTERM)", "exit code 0"),
    ],
    ids=["os._exit", "segfault", "SIGKILL", "SIGTERM"],
)
def test_a_node_whose_process_ends_is_a_failure(bench: Bench, act: str, how: str) -> None:
    go = "@neuros_tick(seconds=0.1, outputs=Optional('o'))\ndef go(node):\n"
    bench.project("a.o -> b.x", a=f"{go}    print('last words')\n    {act}\n", b=SINK)
    finished = bench.launch()
    assert finished.exit_code == 1
    assert re.fullmatch(f"nodes? 'a'( and 'b')? ended unexpectedly.*: {how}", last_line(finished))
    assert "last words" in finished.output
    if how == "killed by SIGSEGV":
        assert "in go" in finished.output, "the Python stack is in the log"
    if bench.back_end == "process":
        assert bench.saved("b", *(["a"] if act.endswith("SIGTERM)") else []))


def test_a_finalise_hook_that_fails_makes_the_project_fail(bench: Bench) -> None:
    fails = "@neuros_finalise()\ndef close(node):\n    raise ValueError('stuck')\n"
    bench.project("b.o -> a.x", a=COUNTS, b=SOURCE + fails)
    finished = bench.launch()
    assert_ended(finished, 1, "node 'b' failed: .*: hook 'close': ValueError: stuck")
    assert bench.saved("a", "b"), "the other finalise hooks have run"


def test_a_node_that_fails_while_the_project_drains_makes_it_fail(bench: Bench) -> None:
    bench.project(
        "a.o -> b.x",
        a="@neuros_tick(seconds=0.1, outputs='o')\ndef end(node):\n"
        "    node.shutdown('enough')\n    return node.make_packet('o')\n",
        b="@neuros_function(inputs='x')\ndef late(node, x):\n    raise ValueError('late')\n",
    )
    assert_ended(bench.launch(), 1, "node 'b' failed: .*: hook 'late': ValueError: late")


def test_a_callback_of_a_plugin_that_fails_is_named_with_its_file(bench: Bench) -> None:
    bench.project(
        a="@neuros_initialise()\ndef begin(node):\n"
        "    node.get_ros_node().create_timer(0.1, break_down)\n"
        "def break_down():\n    raise ValueError('in a timer')\n",
        b=RUNS,
    )
    finished = bench.launch()
    assert_ended(
        finished, 1, r"node 'a' failed: .*a\.py:\d+: callback 'break_down': ValueError: in a timer"
    )
    assert finished.output.count('a.py", line') == 1


def test_nodes_that_all_fail_at_once_end_at_once(bench: Bench) -> None:
    fails = "@neuros_initialise()\ndef begin(node):\n    raise ValueError('at once')\n"
    bench.project(a=fails, b=fails)
    finished = bench.launch()
    assert_ended(finished, 1, "node '[ab]' failed: .*: hook 'begin': ValueError: at once")
    assert "killed" not in finished.output


STEP = """
@neuros_function(inputs=Optional("command"), outputs="sensors")
def step(node, command):
    return node.make_packet("sensors")
"""
CONTROL = """
@neuros_function(inputs="sensors", outputs="command")
def control(node, sensors):
    return node.make_packet("command")
"""


def test_a_deadlock_ends_the_project_and_names_its_cycle(bench: Bench) -> None:
    bench.project(
        "robot.sensors -> brain.sensors",
        "brain.command -> robot.command",
        robot=STEP.replace('Optional("command")', '"command"'),
        brain=CONTROL,
    )
    finished = bench.launch()
    assert_ended(
        finished,
        1,
        "deadlock: nothing can ever run again: brain waits for `sensors` from robot;"
        " robot waits for `command` from brain. .*",
    )
    assert bench.saved("robot", "brain")


def test_a_loop_that_is_full_is_a_deadlock_too(bench: Bench) -> None:
    bench.project(
        "robot.sensors -> brain.sensors",
        "brain.command -> robot.command",
        robot=STEP,
        brain=CONTROL,
    )
    finished = bench.launch()
    assert finished.exit_code == 1
    assert "robot is blocked on `robot.sensors -> brain.sensors`" in last_line(finished)
    assert "brain is blocked on `brain.command -> robot.command`" in last_line(finished)


# ------------------------------------------------------------------ drained ends


def assert_ledgers_close(finished: Finished) -> None:
    for connection in finished.record["connections"]:
        assert connection["received"] == (
            connection["consumed"] + connection["discarded"] + connection["unread"]
        )
        if connection["discard_limit"] is not None:
            assert connection["lost"] == 0, finished.output


def test_a_drained_end_loses_nothing_on_its_way(bench: Bench) -> None:
    bench.project(
        *("a.o -> b.x", "b.o -> c.x", ("b.o -> d.x", None)),
        a=SOURCE,
        b=RELAY,
        c=SINK,
        d=COUNTS,
    )
    finished = bench.launch()
    assert_ended(finished, 0, "d ended the project: enough")
    assert_ledgers_close(finished)
    first, second, _ = finished.record["connections"]
    assert first["consumed"] == first["sent"] == second["sent"] == second["consumed"] > 0
    assert bench.saved(*"abcd")
    assert all(node["report"] == "final" for node in finished.record["nodes"].values())


def test_two_nodes_that_end_the_project_end_it_once(bench: Bench) -> None:
    bench.project(a=ENDS, b=ENDS)
    finished = bench.launch()
    assert_ended(finished, 0, "[ab] ended the project: enough")


def test_packets_that_may_be_lost_do_not_hold_up_the_end(bench: Bench) -> None:
    serves = (
        '@neuros_initialise(outputs=["o", "kept"])\ndef serve(node):\n'
        '    return node.make_packet("o"), node.make_packet("kept")\n'
    )
    bench.project(
        *(("a.o -> b.x", None), ("b.o -> a.x", None), ("b.o -> d.x", None), "a.kept -> c.x"),
        a=serves + RELAY,
        b=RELAY,
        c=SINK,
        d=COUNTS,
    )
    finished = bench.launch()
    assert_ended(finished, 0, "d ended the project: enough")
    assert finished.connection("a.o -> b.x")["received"] >= 50, "it is a flood"
    assert not any("not drained" in text for text in finished.said("neuros"))
    assert_ledgers_close(finished)


def test_a_long_hook_is_waited_for(bench: Bench) -> None:
    bench.project(
        "a.o -> b.x",
        a="@neuros_tick(seconds=0.1, outputs='o')\ndef end(node):\n"
        "    node.shutdown('enough')\n    return node.make_packet('o')\n",
        b="@neuros_function(inputs='x')\ndef work(node, x):\n"
        "    time.sleep(1.0)\n    note(node, 'worked')\n",
    )
    finished = bench.launch()
    assert_ended(finished, 0, "a ended the project: enough")
    assert not any("not drained" in text for text in finished.said("neuros"))
    assert list(bench.folder.rglob("worked"))
    assert finished.connection("a.o -> b.x")["consumed"] == 1


def test_but_no_longer_than_the_plugin_says(bench: Bench) -> None:
    bench.project(
        "a.o -> b.x",
        a="@neuros_tick(seconds=0.1, outputs='o')\ndef end(node):\n"
        "    node.shutdown('enough', drain_s=0.3)\n    return node.make_packet('o')\n",
        b="@neuros_function(inputs='x')\ndef work(node, x):\n    time.sleep(1.0)\n",
    )
    finished = bench.launch()
    assert_ended(finished, 0, "a ended the project: enough")
    assert any("not drained in time" in text for text in finished.said("neuros"))


THREAD = """
@neuros_initialise()
def begin(node):
    def send():
        while node.submit({"o": node.make_packet("o")}, lambda: False):
            pass
        note(node, "stopped")
    thread = threading.Thread(target=send)
    thread.start()
    node.on_close(thread.join)
"""


@pytest.mark.parametrize("limit", [0, None], ids=["lossless", "best effort"])
def test_a_source_in_a_thread_of_its_own_stops_for_the_end(bench: Bench, limit: int | None) -> None:
    bench.project(("a.o -> b.x", limit), ("b.o -> c.x", None), a=THREAD, b=RELAY, c=COUNTS)
    finished = bench.launch()
    assert_ended(finished, 0, "c ended the project: enough")
    assert finished.connection("a.o -> b.x")["consumed"] > 0
    assert not any("not drained" in text for text in finished.said("neuros"))
    assert list(bench.folder.rglob("stopped"))
    assert_ledgers_close(finished)


def test_the_duration_ends_drained(bench: Bench) -> None:
    bench.project("a.o -> b.x", a=SOURCE, b=SINK)
    finished = bench.launch("--duration", "0.5")
    assert_ended(finished, 0, "0.5 s are over")
    assert 0.5 <= finished.record["wall_s"] < 2.5
    assert_ledgers_close(finished)


# ------------------------------------------------------------------ signals


@pytest.mark.parametrize(
    ("number", "exit_code", "reason"),
    [(signal.SIGINT, 130, "ended by Ctrl\\+C"), (signal.SIGTERM, 143, "ended by SIGTERM")],
)
def test_a_signal_ends_a_run(bench: Bench, number: int, exit_code: int, reason: str) -> None:
    bench.project(a=RUNS, b=RUNS)
    running = bench.start()
    running.wait_for("[a]: running")
    running.wait_for("[b]: running")
    running.signal(number)
    assert_ended(running.finish(GONE_WITHIN_S), exit_code, reason)
    assert bench.saved("a", "b")


@pytest.mark.parametrize("delay_s", [0.0, 0.15, 0.35])
def test_ctrl_c_during_start_up_ends_it_whenever_it_comes(bench: Bench, delay_s: float) -> None:
    bench.project("a.o -> b.x", a=SOURCE, b=SINK)
    running = bench.start()
    running.wait_for("run folder")
    time.sleep(delay_s)  # not to wait for something, but to hit different moments
    running.signal(signal.SIGINT)
    assert_ended(running.finish(GONE_WITHIN_S), 130, "ended by Ctrl\\+C")


def test_a_second_ctrl_c_kills_at_once(bench: Bench) -> None:
    bench.project(a=RUNS + "@neuros_finalise()\ndef dawdle(node):\n    time.sleep(30)\n")
    running = bench.start()
    running.wait_for("[a]: running")
    running.signal(signal.SIGINT)
    running.wait_for("all is saved")
    running.signal(signal.SIGINT)
    assert_ended(running.finish(3.0), 130, "ended by Ctrl\\+C")


HOLDS = """
@neuros_tick(seconds=0.1)
def hold(node):
    node.get_logger().info("running")
    {}
"""


def test_nodes_that_cannot_end_are_killed(bench: Bench) -> None:
    bench.project(
        gil=HOLDS.format("ctypes.PyDLL(None).sleep(30)"),
        sleeps=HOLDS.format("time.sleep(30)"),
        stopped=HOLDS.format("os.kill(os.getpid(), signal.SIGSTOP)"),
        good=RUNS,
    )
    running = bench.start()
    for name in ("gil", "sleeps", "stopped") if bench.back_end == "process" else ("gil",):
        running.wait_for(f"[{name}]: running")
    running.signal(signal.SIGTERM)
    assert_ended(running.finish(GONE_WITHIN_S), 143, "ended by SIGTERM")
    if bench.back_end == "process":
        assert bench.saved("good")


def test_nobody_has_to_read_what_is_printed(bench: Bench) -> None:
    bench.project(a="@neuros_tick(seconds=0.001)\ndef talk(node):\n    print('x' * 1000)\n", b=ENDS)
    process = subprocess.Popen(
        [sys.executable, "-m", "neuros.cli", "launch", str(bench.folder), *bench._arguments(())],
        cwd=bench.folder,
        env={**os.environ, MARK: bench.mark},
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        wait_until(lambda: list(bench.folder.rglob("saved")), 10.0)
        process.terminate()  # it would wait for the reader for ever, but not after that
        assert process.wait(5.0) == 0
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


# ------------------------------------------------------------------ killed


def test_when_a_node_is_killed_the_others_end_and_its_last_report_is_shown(bench: Bench) -> None:
    bench.project(a=RUNS, b=RUNS)
    running = bench.start()
    running.wait_for("[b]: running")
    running.wait_for("[a]: running")
    os.kill(bench.pid_of("a"), signal.SIGKILL)
    finished = running.finish(GONE_WITHIN_S)
    assert finished.exit_code == 1
    assert re.fullmatch("nodes? 'a'.* ended unexpectedly.*: killed by SIGKILL", last_line(finished))
    assert re.search(r"last report \d\.\d s before the end", finished.output)
    if bench.back_end == "process":
        assert bench.saved("b")


@pytest.mark.parametrize(
    "moments", [["run folder"], ["[a]: running", "[b]: running"]], ids=["starting", "running"]
)
def test_when_the_launcher_is_killed_everything_ends(bench: Bench, moments: list[str]) -> None:
    bench.project(a=RUNS, b=RUNS)
    running = bench.start()
    for text in moments:
        running.wait_for(text)
    running.signal(signal.SIGKILL)
    running.process.wait()
    bench.outputs.append(running.output)
    wait_until(lambda: not bench.is_anything_left(), GONE_WITHIN_S)
    if len(moments) == 2:
        assert bench.saved("a", "b"), "nodes that were up had their time"


def test_also_when_a_node_holds_the_gil(tmp_path: Path) -> None:
    with made_bench(tmp_path, "process") as bench:
        bench.project(a=HOLDS.format("ctypes.PyDLL(None).sleep(30)"), b=RUNS)
        running = bench.start()
        running.wait_for("[a]: running")
        running.wait_for("[b]: running")
        running.signal(signal.SIGKILL)
        running.process.wait()
        bench.outputs.append(running.output)
        wait_until(lambda: not bench.is_anything_left(), GONE_WITHIN_S)
        assert bench.saved("b")


# ------------------------------------------------------------------ what is said meanwhile


def test_a_standstill_is_explained_and_a_long_hook_named_after_five_seconds(bench: Bench) -> None:
    bench.project(
        "a.o -> b.x",
        "b.o -> c.x",
        "d.o -> c.y",
        a="@neuros_initialise(outputs='o')\ndef think(node):\n"
        "    time.sleep(6.5)\n    return node.make_packet('o')\n",
        b=RELAY,
        c=SINK.replace("inputs='x'", "inputs=['x', 'y']").replace("x)", "x, y=None)"),
        d="@neuros_tick(seconds=60, outputs='o')\ndef rarely(node):\n"
        "    return node.make_packet('o')\n",
    )
    running = bench.start()
    running.wait_for("a has been executing 'think' for 5 s", 10.0)
    if bench.back_end == "process":
        running.wait_for("c waits for `x` from b", 3.0)
        running.wait_for("b waits for `x` from a", 3.0)
        running.wait_for("d waits for the next tick of 'rarely'", 3.0)
    running.signal(signal.SIGINT)
    finished = running.finish()
    assert_ended(finished, 130, "ended by Ctrl\\+C")
    said = finished.said("neuros")
    assert len([text for text in said if "has been executing" in text]) == 1
    if bench.back_end == "process":
        assert not any(text.startswith("a executes") for text in said), "that was said before"


def test_waiting_connections_are_named_after_five_seconds(tmp_path: Path) -> None:
    with made_bench(tmp_path, "process") as bench:
        bench.project("a.o -> b.x", a=SOURCE, b=SINK)
        running = bench.start("-n", "a")
        running.wait_for("connections still waiting for their other end: a.o -> b.x", 8.0)
        running.signal(signal.SIGINT)
        assert running.finish().exit_code == 130


# ------------------------------------------------------------------ side by side


def test_two_runs_at_once_in_one_folder_do_not_meet(bench: Bench) -> None:
    bench.project("a.o -> b.x", ("a.o -> c.x", None), a=SOURCE, b=SINK, c=COUNTS)
    pair = [bench.start(), bench.start()]
    for running in pair:
        running.finish()
        assert running.process.returncode == 0, running.output
    records = [json.loads(file.read_text()) for file in bench.folder.rglob("run.json")]
    assert len({record["domain_id"] for record in records}) == 2
    for record in records:
        lossless, _ = record["connections"]
        assert lossless["sent"] == lossless["consumed"] >= 50
