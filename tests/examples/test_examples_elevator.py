"""The elevator makes its tour, in every variant and on either back end."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from launching import EXAMPLES, Finished, each_time, launch

pytest.importorskip("mujoco")

ELEVATOR = EXAMPLES / "3_physics_simulation/elevator"
READINGS = "elevator.cabin -> controller.cabin"
TARGETS = "controller.target -> elevator.target"
FASTER = ("--set", "nodes.elevator.environment.REAL_TIME_FACTOR=20")

pytestmark = each_time("in-process")


def arrivals(run: Finished) -> list[tuple[int, float]]:
    """Levels, and the simulated time of arrival in seconds."""
    said = run.said("controller")
    matches = (re.fullmatch(r"level (\d) after ([\d.]+) s", text) for text in said)
    return [(int(match[1]), float(match[2])) for match in matches if match]


def test_nothing_is_lost_and_the_tour_takes_the_same_simulated_time(
    backend: str, tmp_path: Path
) -> None:
    run = launch(ELEVATOR, "--backend", backend, cwd=tmp_path)
    assert run.exit_code == 0, run.output
    assert arrivals(run) == [
        (2, pytest.approx(6.55, abs=0.2)),
        (1, pytest.approx(12.0, abs=0.4)),
        (3, pytest.approx(18.55, abs=0.6)),
        (0, pytest.approx(24.6, abs=0.8)),
    ]
    for name in (READINGS, TARGETS):
        counted = run.connection(name)
        assert counted["sent"] == counted["received"]
        assert counted["discarded"] == 0
        assert counted["received"] - counted["consumed"] == counted["unread"] <= 1
    assert run.record["sim_s"] > 24


def test_without_discard_limits_the_physics_never_waits(backend: str, tmp_path: Path) -> None:
    run = launch(ELEVATOR / "no_discard_limit.json", "--backend", backend, cwd=tmp_path)
    assert run.exit_code == 0, run.output
    assert [level for level, _ in arrivals(run)] == [2, 1, 3, 0]
    assert not any(run.record["nodes"]["elevator"]["accounting"]["blocked"].values())


def test_asynchronous_physics_keeps_its_own_pace(backend: str, tmp_path: Path) -> None:
    run = launch(ELEVATOR / "asynchronous.json", "--backend", backend, *FASTER, cwd=tmp_path)
    assert run.exit_code == 0, run.output
    assert [level for level, _ in arrivals(run)] == [2, 1, 3, 0]
    assert 5 < run.record["real_time_factor"] < 21
    counted = run.connection(TARGETS)
    assert counted["sent"] == counted["received"]
    assert counted["discarded"] == 0


def test_the_command_as_an_optional_input_of_the_main_loop_is_a_deadlock(
    backend: str, tmp_path: Path
) -> None:
    shutil.copytree(ELEVATOR, tmp_path / "elevator")
    (tmp_path / "elevator/elevator.py").write_text(
        "from neuros.hooks import Optional, neuros_function, neuros_initialise\n"
        "from neuros.simulators.mujoco import MuJoCo\n"
        "@neuros_initialise()\n"
        "def start(node):\n"
        "    node.set_user_data(MuJoCo(node, 'elevator.xml'))\n"
        "@neuros_function(inputs=Optional('target'), outputs='cabin')\n"
        "def move(node, target):\n"
        "    sim = node.get_user_data()\n"
        "    if target is not None:\n"
        "        sim.command('target', target)\n"
        "    sim.step_to_next()\n"
        "    return sim.read('cabin')\n"
    )
    run = launch("elevator", "--backend", backend, cwd=tmp_path)
    assert run.exit_code == 1
    assert "deadlock" in run.record["reason"]
    assert READINGS in run.record["reason"]
    assert TARGETS in run.record["reason"]
