"""A run begins when every node is ready: all have loaded, and then all have initialised."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from ending_bench import ENDS, Bench, assert_ended, made_bench
from endings import GONE_WITHIN_S, RUNS
from launching import BACKENDS
from starts import (
    INITIALISES_SLOWLY,
    MOMENTS,
    PLUGINS,
    TICKS,
    assert_all_began_together,
    moments,
)

from neuros.backends.domain import choose_domain

SAVES = """
@neuros_finalise()
def save_weights(node):
    with open(node.run_dir / "weights.txt", "w") as file:
        for _ in range(13):
            file.write("x" * 100)
            time.sleep(0.5)
        file.write("END")
"""
PHYSICS = """
from neuros.simulators.mujoco import MuJoCo
WORLD = '''<mujoco><worldbody><body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'''
@neuros_initialise()
def begin(node):
    MuJoCo(node, WORLD).run_asynchronous(1.0)
"""
TAKES_STAMPS = """
@neuros_function(inputs="x")
def take(node, x):
    with (node.run_dir / "stamps.txt").open("a") as file:
        file.write(f"{x.clock.sec + x.clock.nanosec / 1e9}\\n")
"""
AGAIN = """
@neuros_initialise(outputs="o")
def begin(node):
    return node.make_packet("o")
@neuros_function(inputs="x", outputs="o")
def again(node, x):
    if node.get_user_data() is None:
        node.set_user_data("running")
        node.get_logger().info("running")
    return x
"""


@pytest.fixture(params=BACKENDS)
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Bench]:
    with made_bench(tmp_path, request.param) as bench:
        yield bench


def test_no_hook_runs_before_all_have_loaded_and_no_tick_before_all_have_initialised(
    bench: Bench,
) -> None:
    bench.project(**PLUGINS)
    assert_ended(bench.launch("--duration", "0.5"), 0, "0.5 s are over")
    assert_all_began_together(bench.folder)


@pytest.mark.parametrize("first", ["a", "b"])
def test_neither_do_they_before_a_node_of_another_launcher(tmp_path: Path, first: str) -> None:
    with made_bench(tmp_path, "process") as bench, choose_domain(None, {}, False) as domain:
        bench.project(**PLUGINS)
        options = ("-d", str(domain.id), "--duration", "0.5")
        parts = [
            ["-n", first],
            [part for name in PLUGINS if name != first for part in ("-n", name)],
        ]
        pair = [bench.start(*part, *options) for part in parts]
        for running in pair:
            assert running.finish(30.0).exit_code == 0, running.output
        assert_all_began_together(bench.folder)
        assert bench.saved(*PLUGINS)


def test_an_end_that_a_node_asks_for_as_it_initialises_waits_until_all_have(bench: Bench) -> None:
    ends = "@neuros_initialise()\ndef end(node):\n    node.shutdown('enough')\n"
    bench.project(a=ends + MOMENTS + TICKS, b=MOMENTS + INITIALISES_SLOWLY + TICKS)
    assert_ended(bench.launch(), 0, "a ended the project: enough")
    assert bench.saved("a", "b")
    assert set(moments(bench.folder)["b"]) == {"loaded", "initialising", "initialised"}


def test_what_a_finalise_hook_saves_slowly_is_saved_to_its_end(bench: Bench) -> None:
    bench.project(a=SAVES + ENDS)
    finished = bench.launch()
    assert_ended(finished, 0, "a ended the project: enough")
    assert "saving: 'a' (finalise hook 'save_weights')" in finished.said("neuros")
    (file,) = bench.folder.rglob("weights.txt")
    assert file.read_text() == "x" * 1300 + "END"


def test_physics_that_runs_by_itself_starts_when_all_are_ready(bench: Bench) -> None:
    file = bench.project(
        ("robot.o -> b.x", None), robot=PHYSICS, b=MOMENTS + INITIALISES_SLOWLY + TAKES_STAMPS
    )
    project = json.loads(file.read_text())
    robot, b = project["nodes"]
    robot["outputs"][0] |= {
        "type": "rosgraph_msgs/msg/Clock",
        "mujoco": {"sensor": "clock", "rate": 50},
    }
    robot["container"] = "neuros_mujoco"
    b["inputs"][0]["type"] = "rosgraph_msgs/msg/Clock"
    file.write_text(json.dumps(project))
    finished = bench.launch("--duration", "1")
    assert_ended(finished, 0, "1 s are over")
    (taken,) = bench.folder.rglob("stamps.txt")
    stamps = [float(line) for line in taken.read_text().split()]
    assert stamps[0] == 0.02, "the first packet was sent when its receiver was ready"
    assert stamps[-1] < 1.5
    assert finished.connection("robot.o -> b.x")["sent"] < 75


@pytest.mark.parametrize("ends_by", ["--duration", "Ctrl+C"])
def test_a_ring_of_one_ends_in_time(bench: Bench, ends_by: str) -> None:
    file = bench.project("a.o -> a.x", a=AGAIN, b=RUNS)
    project = json.loads(file.read_text())
    project["connections"][0]["queue_size"] = 3
    file.write_text(json.dumps(project))
    with bench.start(*(["--duration", "1"] if ends_by == "--duration" else [])) as running:
        running.wait_for("[a]: running")
        running.wait_for("[b]: running")
        if ends_by == "Ctrl+C":
            running.signal(2)
            running.wait_for("Ctrl+C: stopping", GONE_WITHIN_S)
        else:
            running.wait_for("1 s are over; letting packets under way arrive", GONE_WITHIN_S)
        finished = running.finish(GONE_WITHIN_S)
    reason, code = ("1 s are over", 0) if ends_by == "--duration" else ("ended by Ctrl\\+C", 130)
    assert_ended(finished, code, reason)
    assert finished.connection("a.o -> a.x")["consumed"] > 100
    assert bench.saved("a", "b")
