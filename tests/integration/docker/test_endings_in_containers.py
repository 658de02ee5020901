"""In containers, too: what hangs is said, ends say what happened, and a loop in lockstep ends."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from ending_bench import RELAY, Bench, assert_ended, made_bench
from endings import KEEP_THE_GIL, RUNS

from containers import connected, nothing_left, require_containers

HOLDS = f"""
@neuros_tick(seconds=1.0)
def hold(node):
    node.shutdown("enough", drain_s=0.2)
    {KEEP_THE_GIL}
"""
HANGS = """
@neuros_finalise()
def close(node):
    time.sleep(60)
"""
WRITES = """
import atexit
@neuros_initialise()
def begin(node):
    global KEPT
    KEPT = open(node.run_dir / "rows", "w")
    for number in range(1000):
        print(number, file=KEPT)
    atexit.register(note, node, "at exit")
"""
COMPUTES = """
@neuros_tick(seconds=0.1)
def compute(node):
    node.get_logger().info("computing")
    while True:
        pass
"""
BEGINS = """
@neuros_initialise(outputs="o")
def begin(node):
    return node.make_packet("o")
"""


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    require_containers()
    with nothing_left(tmp_path), made_bench(tmp_path, "docker") as bench:
        yield bench


def test_a_node_that_had_to_be_killed_is_a_failure_and_it_is_said_where_it_stood(
    bench: Bench,
) -> None:
    bench.project(("gil.o -> hangs.x", None), gil=HOLDS, hangs=RUNS + HANGS)  # both have begun
    finished = bench.launch(timeout_s=40.0)
    assert finished.exit_code == 1
    for node, what in {
        "gil": "'gil' was still executing 'hold'; finalise hook 'save' of 'gil' did not run",
        "hangs": "finalise hook 'close' of 'hangs' did not finish",
    }.items():
        assert f"'{node}' had to be killed after 5 s without progress: {what}" in finished.output
        assert f"{node} was at this point when it was killed:\n" in finished.output
        assert f'File "{bench.folder}/{node}.py", line ' in finished.record["nodes"][node]["stack"]


def test_a_container_that_was_paused_while_it_computed_is_said_to_be_paused(bench: Bench) -> None:
    bench.project(busy=COMPUTES)
    running = bench.start()
    running.wait_for("computing", 20.0)
    with connected() as engine:
        (container,) = (
            each
            for each in engine.containers.list(ignore_removed=True)
            if each.labels.get("neuros.run_folder", "").startswith(f"{bench.folder}/")
        )
        container.pause()
        running.wait_for(": the container is paused\n")
        container.unpause()
    running.signal(signal.SIGINT)
    running.wait_for("a second one kills at once")
    running.signal(signal.SIGINT)
    finished = running.finish()
    assert finished.exit_code == 130
    assert "busy has not reported for 5 s" in finished.output
    assert ", and cannot report" not in finished.output


def test_a_loop_in_lockstep_ends_after_one_more_round_and_leaves_whole_files(bench: Bench) -> None:
    bench.project(
        "a.o -> b.x", "b.o -> a.x", a=BEGINS + WRITES.replace("begin", "open_") + RELAY, b=RELAY
    )
    finished = bench.launch("--duration", "0.5", timeout_s=40.0)
    assert_ended(finished, 0, "0.5 s are over")
    assert "not drained" not in finished.output
    there, back = finished.record["connections"]
    assert there["lost"] == back["lost"] == 0
    assert there["unread"] + back["unread"] == 1
    assert finished.run_folder is not None
    assert len((finished.run_folder / "a" / "rows").read_text().splitlines()) == 1000
    assert (finished.run_folder / "a" / "at exit").exists()
