"""A project that is interrupted or killed ends, and one that stands still says why."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from deadlines import wait_until
from ending_bench import (
    COUNTS,
    ENDS,
    MARK,
    RELAY,
    SINK,
    SOURCE,
    Bench,
    assert_ended,
    last_line,
    made_bench,
)
from endings import GONE_WITHIN_S, KEEP_THE_GIL, RUNS
from launching import BACKENDS, REPOSITORY


@pytest.fixture(params=BACKENDS)
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Bench]:
    with made_bench(tmp_path, request.param) as bench:
        yield bench


# ------------------------------------------------------------------ signals


@pytest.mark.parametrize("delay_s", [0.0, 0.35])
def test_ctrl_c_during_start_up_ends_it_whenever_it_comes(bench: Bench, delay_s: float) -> None:
    bench.project("a.o -> b.x", a=SOURCE, b=SINK)
    running = bench.start()
    running.wait_for("run folder")
    time.sleep(delay_s)  # not to wait for something, but to hit different moments
    running.signal(signal.SIGINT)
    assert_ended(running.finish(GONE_WITHIN_S), 130, "ended by Ctrl\\+C")


@pytest.mark.parametrize("program", [["launch.py"], ["-m", "neuros.cli", "launch"]])
def test_ctrl_c_before_anything_is_imported_waits_and_leaves_no_traceback(
    tmp_path: Path, program: list[str]
) -> None:
    with made_bench(tmp_path, "process") as bench:
        bench.project(a=RUNS)
        process = subprocess.Popen(
            [sys.executable, *program, str(bench.folder), "-o", str(bench.folder / "run")],
            cwd=REPOSITORY,
            env={**os.environ, MARK: bench.mark},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            wait_until(lambda: _waits_with_ctrl_c(process.pid), 10.0)
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=20.0)
        finally:
            process.kill()
            process.communicate()
        assert process.returncode == 130, output.decode()
        assert b"Traceback" not in output
        assert output.rstrip().endswith(b"ended by Ctrl+C")


@pytest.mark.parametrize("backend", ["process", "in-process"])
def test_ctrl_c_after_the_last_word_changes_nothing(tmp_path: Path, backend: str) -> None:
    with made_bench(tmp_path, backend) as bench:
        bench.project("a.o -> b.x", a=SOURCE, b=SINK)
        for number in range(1):
            folder = bench.folder / f"run {number}"
            options = ["--backend", backend, "--duration", "0.2", "-o", str(folder)]
            process = subprocess.Popen(
                [sys.executable, "launch.py", str(bench.folder), *options],
                cwd=REPOSITORY,
                env={**os.environ, MARK: bench.mark},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            try:
                wait_until((folder / "run.json").exists, 30.0)
                code = json.loads((folder / "run.json").read_text())["exit_code"]
                deadline_s = time.monotonic() + 20.0
                while process.poll() is None:
                    process.send_signal(signal.SIGINT)
                    assert time.monotonic() < deadline_s
            finally:
                process.kill()
                process.wait()
            assert process.returncode == code == 0


def _waits_with_ctrl_c(pid: int) -> bool:
    """Whether a process has blocked SIGINT."""
    (mask,) = re.findall(r"SigBlk:\s*([0-9a-f]+)", Path(f"/proc/{pid}/status").read_text())
    return bool(int(mask, 16) >> (signal.SIGINT - 1) & 1)


OUTLASTS_B = """
@neuros_tick(seconds=0.1, outputs=["o", "p"])
def send(node):
    node.get_logger().info("running")
    saved, deadline_s = node.run_dir.parent / "b" / "saved", time.monotonic() + 4.0
    while not saved.exists() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return node.make_packet("o"), node.make_packet("p")
"""


def test_what_is_sent_to_a_node_that_has_stopped_is_in_flight_and_not_lost(tmp_path: Path) -> None:
    with made_bench(tmp_path, "process") as bench:
        wires = ("a.o -> b.x", ("a.p -> b.y", None))
        bench.project(*wires, a=OUTLASTS_B, b=SINK + SINK.replace("x", "y"))
        running = bench.start()
        running.wait_for("[a]: running")
        running.signal(signal.SIGINT)
        finished = running.finish(GONE_WITHIN_S)
    assert_ended(finished, 130, "ended by Ctrl\\+C")
    counts = ("sent", "received", "in_flight", "lost")
    lossless, best_effort = (
        [each[count] for count in counts] for each in finished.record["connections"]
    )
    assert lossless == [1, 0, 1, 0]
    assert best_effort == [1, 0, 0, 1], "nobody can tell"
    assert "in flight" in finished.output


HOLDS = """
@neuros_tick(seconds=0.1)
def hold(node):
    node.get_logger().info("running")
    {}
"""


def test_nodes_that_cannot_end_are_killed(bench: Bench) -> None:
    bench.project(
        gil=HOLDS.format(KEEP_THE_GIL),
        sleeps=HOLDS.format("time.sleep(30)"),
        stopped=HOLDS.format("os.kill(os.getpid(), signal.SIGSTOP)"),
        good=RUNS,
    )
    running = bench.start()
    everyone = ("gil", "sleeps", "stopped", "good")
    for name in everyone if bench.back_end == "process" else ("gil",):
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


KEEPS_FROM_BEGINNING = """
import sys
from pathlib import Path
from neuros.cli.main import main
from neuros.control import Begin
from neuros.launcher.channels import Channels
send = Channels.send
def send_no_begin(self, message):
    if isinstance(message, Begin):
        Path("loaded").touch()
    else:
        send(self, message)
Channels.send = send_no_begin
sys.exit(main(["launch", *sys.argv[1:]]))
"""


def test_no_hook_runs_of_a_node_that_had_not_begun(bench: Bench) -> None:
    """Its finalise hook may rely on what its initialise hook has made."""
    bench.project(a=RUNS)
    running = bench.start(program=[sys.executable, "-c", KEEPS_FROM_BEGINNING])
    wait_until((bench.folder / "loaded").exists)
    running.signal(signal.SIGKILL)
    running.process.wait()
    bench.outputs.append(running.output)
    wait_until(lambda: not bench.is_anything_left(), GONE_WITHIN_S)
    assert "[a]: running" not in running.output
    assert not [*bench.folder.rglob("saved")]


def test_also_when_a_node_holds_the_gil(tmp_path: Path) -> None:
    with made_bench(tmp_path, "process") as bench:
        bench.project(a=HOLDS.format(KEEP_THE_GIL), b=RUNS)
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
    holds = {"gil": HOLDS.format(KEEP_THE_GIL)}
    bench.project(
        "a.o -> b.x",
        "b.o -> c.x",
        "d.o -> c.y",
        **(holds if bench.back_end == "process" else {}),
        a="@neuros_tick(seconds=0.1, outputs='o')\ndef think(node):\n"
        "    time.sleep(6.5)\n    return node.make_packet('o')\n",
        b=RELAY,
        c=SINK.replace("inputs='x'", "inputs=['x', 'y']").replace("x)", "x, y=None)"),
        d="@neuros_tick(seconds=60, outputs='o')\ndef rarely(node):\n"
        "    return node.make_packet('o')\n",
    )
    running = bench.start()
    running.wait_for("a has been executing 'think' for 5 s", 20.0)
    if bench.back_end == "process":
        running.wait_for("c waits for `x` from b", 3.0)
        running.wait_for("b waits for `x` from a", 3.0)
        running.wait_for("d waits for the next tick of 'rarely'", 3.0)
        running.wait_for("gil has been executing 'hold' for 5 s, and cannot report", 5.0)
        running.wait_for(f'"{bench.folder}/gil.py", line ', 1.0)
    running.signal(signal.SIGINT)
    finished = running.finish()
    assert_ended(finished, 130, "ended by Ctrl\\+C")
    said = finished.said("neuros")
    named = [text for text in said if text.startswith("a has been executing")]
    assert named == ["a has been executing 'think' for 5 s:"]
    assert f'  File "{bench.folder}/a.py", line ' in finished.output
    if bench.back_end == "process":
        assert not any(text.startswith("a executes") for text in said), "that was said before"
    else:
        assert not any(" waits for " in text for text in said), "all wait for that hook"


def test_until_every_node_has_initialised_the_others_are_said_to_wait(bench: Bench) -> None:
    thinks = "@neuros_initialise()\ndef think(node):\n    time.sleep(6.5)\n"
    bench.project("a.o -> b.x", a=SOURCE + thinks, b=SINK + RUNS)
    running = bench.start("--duration", "0.5")
    waiting = "a" if bench.back_end == "process" else "a, b"  # in process b has its turn later
    running.wait_for(f"still initialising: {waiting}\n", 20.0)
    running.wait_for("a has been executing 'think' for 5 s", 3.0)
    assert "[b]: running" not in running.output
    finished = running.finish(GONE_WITHIN_S + 5.0)
    assert_ended(finished, 0, "0.5 s are over")
    assert "[b]: running" in finished.output
    assert not any(" waits " in text for text in finished.said("neuros")), "all wait for a"


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
