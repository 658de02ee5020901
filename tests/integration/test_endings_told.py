"""What did not go well at the end is said, and no exit code 0; a loop in lockstep ends at once."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from ending_bench import ENDS, RELAY, SINK, SOURCE, Bench, assert_ended, last_line, made_bench
from endings import KEEP_THE_GIL, RUNS
from launching import BACKENDS


@pytest.fixture(params=BACKENDS)
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Bench]:
    with made_bench(tmp_path, request.param) as bench:
        yield bench


# ------------------------------------------------------------------ killed


HOLDS = f"""
@neuros_initialise(outputs="o")
def begin(node):
    return node.make_packet("o")
@neuros_tick(seconds=0.5)
def hold(node):
    node.shutdown("enough", drain_s=0.2)
    deep()
def deep():
    {KEEP_THE_GIL}
"""
HOLDS_ASIDE = f"""
import threading
@neuros_tick(seconds=0.05)
def beat(node):
    if not node.get_user_data():
        node.set_user_data(True)
        threading.Thread(target=work, daemon=True).start()
def work():
    {KEEP_THE_GIL}
"""
HANGS = """
@neuros_finalise()
def close(node):
    while True:
        time.sleep(0.1)
"""


def test_a_node_that_had_to_be_killed_is_a_failure_and_it_is_said_where_it_stood(
    bench: Bench,
) -> None:
    plugins = {"gil": HOLDS, "hangs": RUNS + HANGS, "good": SINK}
    if bench.back_end == "process":
        plugins["aside"] = HOLDS_ASIDE
    file = bench.project("gil.o -> good.x", **plugins)
    budgets = {"lost_packets": {"gil.o -> good.x": 0}}
    file.write_text(json.dumps({**json.loads(file.read_text()), "budgets": budgets}))
    finished = bench.launch()
    assert finished.exit_code == finished.record["exit_code"] == 1
    held = r"had to be killed after 5 s without progress: 'gil' was still executing 'hold';"
    assert re.search(
        f"nodes? 'gil'.* {held} finalise hook 'save' of 'gil' did not run", finished.output
    )
    assert "gil was at this point when it was killed:\n" in finished.output
    assert "in hold\n" in finished.record["nodes"]["gil"]["stack"]
    assert "in deep" in finished.record["nodes"]["gil"]["stack"]
    assert len(finished.record["broken_budgets"]) == 1, "it is not known what was lost"
    if bench.back_end == "process":
        assert (
            "node 'hangs' had to be killed after 5 s without progress:"
            " finalise hook 'close' of 'hangs' did not finish" in finished.output
        )
        assert "hangs was at this point when it was killed:\n" in finished.output
        assert "in close\n" in finished.record["nodes"]["hangs"]["stack"]
        assert bench.saved("good", "hangs")
        assert "in work" in finished.record["nodes"]["aside"]["stack"]


def test_so_is_one_whose_finalise_hook_hangs_though_all_else_went_well(tmp_path: Path) -> None:
    """In process it alone is to blame: not one before it, nor those that wait behind it."""
    with made_bench(tmp_path, "in-process") as bench:
        bench.project(good=RUNS, a=RUNS + HANGS, b=RUNS)
        finished = bench.launch("--duration", "0.5")
        assert_ended(
            finished,
            1,
            "node 'a' had to be killed after 5 s without progress: finalise hook 'close' of"
            " 'a' did not finish; finalise hook 'save' of 'b' did not run",
        )
        assert "in close\n" in finished.record["nodes"]["a"]["stack"]


TAKES_2_S = """
@neuros_finalise()
def close(node):
    threading.Event().wait(2.0)
"""


def test_each_node_of_a_process_has_its_five_seconds_and_its_counters_are_complete(
    tmp_path: Path,
) -> None:
    """The three of them take 6 s."""
    with made_bench(tmp_path, "in-process") as bench:
        bench.project(
            "a.o -> c.x", a=SOURCE + ENDS + TAKES_2_S, b=RUNS + TAKES_2_S, c=SINK + TAKES_2_S
        )
        finished = bench.launch()
        assert_ended(finished, 0, "a ended the project: enough")
        assert bench.saved("a", "b", "c")
        counted = finished.connection("a.o -> c.x")
        assert counted["sent"] == counted["received"] == counted["consumed"] > 0


# ------------------------------------------------------------------ as Python programs end


WRITES = """
import atexit, gzip
@neuros_initialise()
def begin(node):
    global KEPT
    KEPT = open(node.run_dir / "global", "w")
    files = [open(node.run_dir / "user data", "w"), gzip.open(node.run_dir / "packed", "wt")]
    files.append(files)  # only the garbage collector will find it
    node.set_user_data(files)
    for number in range(1000):
        for file in (KEPT, *files[:2]):
            print(number, file=file)
    atexit.register(note, node, "at exit")
"""


def test_a_node_ends_as_a_python_program_ends(bench: Bench) -> None:
    import gzip

    bench.project(a=WRITES + RUNS)
    finished = bench.launch("--duration", "0.2")
    assert_ended(finished, 0, "0.2 s are over")
    assert finished.run_folder is not None
    folder = finished.run_folder / "a"
    rows = "".join(f"{number}\n" for number in range(1000))
    assert (folder / "global").read_text() == rows
    assert (folder / "user data").read_text() == rows
    assert gzip.decompress((folder / "packed").read_bytes()).decode() == rows
    assert (folder / "at exit").exists()


FORKS = """
import atexit, os
@neuros_tick(seconds=0.02, outputs="o")
def send(node):
    count = node.get_user_data() or 0
    node.set_user_data(count + 1)
    if count == 3:
        child = os.fork()
        if child == 0:
            atexit._run_exitfuncs()  # as sys.exit does
            os._exit(7)
        _, status = os.waitpid(child, 0)
        (node.run_dir / "child").write_text(str(os.waitstatus_to_exitcode(status)))
    if count == 20:
        node.shutdown("enough")
    return node.make_packet("o")
"""


def test_a_fork_of_a_node_ends_as_a_python_program_and_leaves_ros_to_the_node(bench: Bench) -> None:
    bench.project("a.o -> b.x", a=FORKS, b=SINK)
    finished = bench.launch()
    assert_ended(finished, 0, "a ended the project: enough")
    assert finished.run_folder is not None
    assert (finished.run_folder / "a" / "child").read_text() == "7"
    assert finished.record["connections"][0]["received"] == 21


# ------------------------------------------------------------------ lockstep


def test_a_loop_in_lockstep_ends_after_one_more_round(bench: Bench) -> None:
    begins = "@neuros_initialise(outputs='o')\ndef begin(node):\n    return node.make_packet('o')\n"
    bench.project("a.o -> b.x", "b.o -> a.x", "a.o -> c.x", a=begins + RELAY, b=RELAY, c=SINK)
    finished = bench.launch("--duration", "0.5")
    assert_ended(finished, 0, "0.5 s are over")
    assert "not drained" not in finished.output
    connections = finished.record["connections"]
    assert all(c["lost"] == 0 and c["received"] == c["sent"] > 10 for c in connections)
    there, back, aside = connections
    assert there["unread"] + back["unread"] == 1, "the one packet of the loop"
    assert aside["unread"] == 0
    assert last_line(finished) == "0.5 s are over"


# ------------------------------------------------------------------ output without room


def test_a_run_whose_output_has_no_room_goes_on_and_its_command_says_so(tmp_path: Path) -> None:
    clock = Path(__file__).parents[2] / "examples/1_tick/clock"
    run = tmp_path / "run"
    command = [sys.executable, "-m", "neuros.cli", "launch", str(clock), "-o", str(run)]
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*command, "--backend", "in-process", "--duration", "1.5"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            check=False,
        )
    assert done.returncode == 4
    assert done.stderr.splitlines()[-1] == (
        "neuros: the run went well, but its output could not be written (No space left on device):"
        f" {tmp_path}/run/run.json has the table"
    )
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["exit_code"] == 0
    assert record["connections"][0]["received"] > 0
