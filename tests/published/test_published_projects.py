"""Projects in the style of the published NeuROS 1.0 run as they are.

Message types with dots, numbers in the environment, no ``$schema``, ``gazebo_type`` on ports,
Gazebo's container, variables and SDF files, the logger of the ROS node, and no way to end by
themselves.
"""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from launching import Finished, each_time, launch, start

from neuros.backends.domain import choose_domain

HERE = Path(__file__).resolve().parent

pytestmark = each_time("process")


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """External topics would take each project to domain 0, where others run beside it."""
    with choose_domain(None, {}, False) as lock:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(lock.id))
        yield


def run_until(name: str, text: str, backend: str, cwd: Path) -> Finished:
    """Run until ``text`` was printed and then to Ctrl+C, as these projects do not end."""
    with start(HERE / name, "--backend", backend, cwd=cwd) as running:
        running.wait_for(text)
        running.signal(signal.SIGINT)
        run = running.finish()
    assert run.exit_code == 130, run.output
    for connection in run.record["connections"]:
        assert 0 <= connection["sent"] - connection["received"] <= 1
        if connection["discard_limit"] == 0:
            assert connection["discarded"] == 0
    return run


def test_the_clock_strikes(backend: str, tmp_path: Path) -> None:
    run = launch(HERE / "clock", "--backend", backend, "--duration", "1", cwd=tmp_path)
    assert run.exit_code == 0, run.output
    strokes = run.said("clock")
    assert 2 <= len(strokes) <= 5
    assert all(re.fullmatch(r"d[io]ng at \d\d:\d\d:\d\d", stroke) for stroke in strokes)


def test_the_ball_goes_to_and_fro(backend: str, tmp_path: Path) -> None:
    run = run_until("tennis", ": right plays pong", backend, tmp_path)
    left, right = run.said("left_player"), run.said("right_player")
    assert left == ["left plays ping"] * len(left)
    assert right == ["right plays pong"] * len(right)
    assert right
    assert 0 <= len(left) - len(right) <= 1


def test_every_vote_is_counted_in_every_election(backend: str, tmp_path: Path) -> None:
    said = run_until("voting", ": counted [", backend, tmp_path).said("station")
    assert "the polls are open" in said
    counted = [text for text in said if text.startswith("counted")]
    assert set(counted) == {"counted ['blue', 'green', 'red']"}


def test_a_plugin_can_look_around(backend: str, tmp_path: Path) -> None:
    run = run_until("census", "[citizen]: counted", backend, tmp_path)
    assert run.said("census") == [
        "found /neuros/census/start/citizen/start/data",
        "Type: std_msgs/msg/Empty",
    ]


def test_a_gazebo_type_gives_one_warning_and_no_more(backend: str, tmp_path: Path) -> None:
    run = run_until("thermostat", "[thermostat]: off", backend, tmp_path)
    assert run.output.count("Gazebo itself is not supported") == 1
    switched = run.said("thermostat")
    assert switched[:2] == ["on", "off"]
    assert run.connection("room.temperature -> thermostat.temperature")["longest_discard"] <= 2


def test_what_only_gazebo_understood_is_named_and_the_elevator_goes_all_the_same(
    backend: str, tmp_path: Path
) -> None:
    run = run_until("elevator", "[control]: at level 1", backend, tmp_path)
    assert run.said("control")[:3] == ["at level 2", "at level 0", "at level 1"]
    for place, what in (
        ("physics.json:3:19: /container", "runs in 'neuros_mujoco' instead of 'neuros_gazebo'"),
        ("physics.json:8:22: /inputs/0/gazebo_type", "'_clock', '_state', '_command'"),
        ("physics.json:21:56: /environment/GZ_PARTITION", "has no effect"),
        ("elevator.sdf:8: world[shaft]/plugin[gz::sim::systems::Physics]", "Gazebo"),
    ):
        (line,) = (line for line in run.output.splitlines() if place in line)
        assert what in line


def test_a_world_and_a_robot_in_sdf_are_found_where_gazebo_found_them(
    backend: str, tmp_path: Path
) -> None:
    run = run_until("whiskeye", " 3 s: turned 3.0, close", backend, tmp_path)
    turned = [f"{second} s: turned {second}.0, close" for second in (1, 2, 3)]
    assert run.said("visualiser")[:3] == turned
    assert "/environment/GZ_SIM_SYSTEM_PLUGIN_PATH: " in run.output
    assert "input 'odom_correction' of node 'brain' is not connected" in run.output
