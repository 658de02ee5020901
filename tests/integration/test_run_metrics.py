"""What ``run.json`` keeps of a real run, on every back end."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launching import BACKENDS, EXAMPLES, Finished, launch, start

PROJECT = EXAMPLES / "1_tick/clock"
TIME = Path(__file__).parent / "back_ends/time"


@pytest.fixture(scope="module", params=BACKENDS)
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The clock, ticking every second, for three and a half."""
    folder = tmp_path_factory.mktemp("clock")
    set_seed = ("--set", "nodes.clock.environment.SEED=7")
    finished = launch(
        PROJECT, "--backend", request.param, "--duration", "3.5", *set_seed, cwd=folder
    )
    assert finished.exit_code == 0, finished.output
    return finished


def test_it_has_what_the_run_was_made_of(run: Finished) -> None:
    record = run.record
    assert record["seeds"] == {"clock": {"SEED": "7"}}
    assert any("clock" in part for part in record["command"])
    assert record["versions"]["packages"]["ros_jazzy_rclpy"]
    assert record["versions"]["nodes"] == {}, "they run on the launcher's Python"
    assert record["machine"]["cores"] >= 1
    names = [node["name"] for node in record["expanded_project"]["nodes"]]
    assert names == ["clock", "display"]
    assert "SEED" in record["expanded_project"]["nodes"][0]["environment"]
    assert "git" in record


def test_it_has_the_intervals_of_the_timed_hook(run: Finished) -> None:
    (ticks,) = (
        hook["ticks"] for hook in run.record["nodes"]["clock"]["hooks"].values() if "ticks" in hook
    )
    assert ticks["period_ms"] == 1000.0
    assert ticks["intervals"] >= 1
    assert sum(count for _, count in ticks["histogram"]) == ticks["intervals"]
    assert ticks["min_ms"] <= ticks["mean_ms"] <= ticks["max_ms"]


def test_what_was_consumed_has_the_digest_of_what_was_sent(run: Finished) -> None:
    (connection,) = run.record["connections"]
    digests = connection["digests"]
    assert digests["sent_packets"] == connection["sent"] > 1
    assert digests["consumed_packets"] == connection["consumed"] == connection["sent"]
    assert digests["consumed"] == digests["sent"]


@pytest.mark.parametrize("back_end", BACKENDS)
def test_simulated_time_has_a_point_per_second(tmp_path: Path, back_end: str) -> None:
    finished = launch(TIME, "--backend", back_end, "--duration", "2.5sim", cwd=tmp_path)
    assert finished.exit_code == 0, finished.output
    points = finished.record["timeline"]["clock"]
    assert [int(sim_s) for sim_s, _ in points] == [*range(int(points[0][0]), len(points))]
    assert len(points) >= 3
    walls = [wall_s for _, wall_s in points]
    assert walls == sorted(walls)
    assert -1.0 < walls[0] < finished.record["wall_s"] + 1.0


def test_a_record_that_cannot_be_written_is_put_elsewhere(tmp_path: Path) -> None:
    """A plugin puts a folder where ``run.json`` would go."""
    plugin = """
import os
from neuros.hooks import neuros_tick
@neuros_tick(seconds=0.05)
def block(node):
    os.mkdir("run.json")
    node.shutdown("done")
"""
    (tmp_path / "a.py").write_text(plugin)
    node = {"name": "a", "container": "neuros_python", "plugin": "a.py"}
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [node], "connections": []}))
    spare = tmp_path / "spare"
    spare.mkdir()
    options = ("--backend", "process", "-o", str(tmp_path / "run"))
    with start(tmp_path, *options, cwd=spare, TMPDIR=str(spare)) as running:
        finished = running.finish(30.0)
    assert finished.exit_code == 4, finished.output
    (record,) = spare.glob("neuros-*/run.json")
    assert f"run.json cannot be written (Is a directory): it is in {record.parent}" in (
        finished.output
    )
    written = json.loads(record.read_text())
    assert written["exit_code"] == 4
    assert written["nodes"]["a"]["report"] == "final"
