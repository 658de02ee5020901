"""However nodes fail: the exit code, the last line, complete logs, and nothing left behind.

Real launchers, guardians and nodes on real rclpy, on both back ends; so in `test_endings_drained`
and `test_endings_interrupted`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from ending_bench import (
    COUNTS,
    SINK,
    SOURCE,
    Bench,
    assert_ended,
    last_line,
    made_bench,
)
from endings import RUNS
from launching import BACKENDS


@pytest.fixture(params=BACKENDS)
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Bench]:
    with made_bench(tmp_path, request.param) as bench:
        yield bench


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
    limits = f"{-(2**31)} to {2**31 - 1}"
    what = rf"packet for output 'o': field 'data' must be int32: {limits}, but is 'three' \(str\)"
    assert_ended(finished, 1, rf"node 'a' failed: .*a\.py:\d+: hook 'fill': {what}")
    assert "Traceback" not in finished.output


@pytest.mark.parametrize(
    ("plugin", "reason"),
    [
        ("import no_such_package", ".*/a.py: cannot be imported: ModuleNotFoundError: .*"),
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


def test_plugins_that_could_not_run_are_all_named_and_nothing_is_started(bench: Bench) -> None:
    bench.project(a="def broken(:", b="@neuros_tick(seconds=0.1)\ndef tick(): pass")
    finished = bench.launch()
    assert finished.exit_code == 3
    assert finished.run_folder is None
    broken, tick, count = finished.output.splitlines()
    assert re.fullmatch(r".*a\.py:\d+:12: syntax error: invalid syntax", broken)
    assert re.fullmatch(r".*b\.py:\d+:1: hook 'tick' gets \(node\), but takes \(\)", tick)
    assert count == "2 problems; nothing was started"


@pytest.mark.parametrize(
    ("act", "how"),
    [
        ("ctypes.string_at(0)", "killed by SIGSEGV"),
        ("os.kill(os.getpid(), signal.SIGTERM)", "exit code 0"),
    ],
    ids=["segfault", "SIGTERM"],
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
    fails = "@neuros_finalise()\ndef close(node):\n    raise ValueError('stuck \\udc80')\n"
    bench.project("b.o -> a.x", a=COUNTS, b=SOURCE + fails)
    finished = bench.launch()
    assert_ended(finished, 1, r"node 'b' failed: .*: hook 'close': ValueError: stuck \\udc80")
    assert "in close" in finished.output, "half a character is no obstacle"
    assert bench.saved("a", "b"), "the other finalise hooks have run"


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
