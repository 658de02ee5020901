"""Simulated time: on /clock, which a plain rclpy program follows, too, and in ticks by it."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from launching import each_time, launch, start

from containers import require_containers
from neuros.backends.domain import choose_domain
from neuros.backends.node_command import with_libraries

PROJECT = Path(__file__).parent / "sim_time"
TICKS = Path(__file__).parent / "sim_ticks"
LIMIT_S = 60.0
IN_A_NAMESPACE = ("--namespace", "/lab", "--remap", "/clock:=clock")
PLAIN_IN_A_NAMESPACE = ("--ros-args", "-r", "__ns:=/lab", "-r", "/clock:=clock")


@pytest.mark.parametrize(
    ("back_end", "names", "plain_names"),
    [
        pytest.param("process", (), (), marks=pytest.mark.acceptance),
        pytest.param("docker", (), (), marks=pytest.mark.acceptance),
        ("in-process", IN_A_NAMESPACE, PLAIN_IN_A_NAMESPACE),
    ],
)
def test_clocks_follow_the_physics(
    back_end: str, names: tuple[str, ...], plain_names: tuple[str, ...], tmp_path: Path
) -> None:
    if back_end == "docker":
        require_containers("neuros_python", "neuros_mujoco")
    with choose_domain(None, {}, False) as domain:
        arguments = ("--backend", back_end, "-d", str(domain.id), *names)
        environment = {"ROS_DOMAIN_ID": str(domain.id)}
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        with start(PROJECT, *arguments, cwd=tmp_path) as running:
            heard = subprocess.run(
                [sys.executable, str(PROJECT / "plain.py"), *plain_names],
                env=with_libraries({**os.environ, **environment}),
                capture_output=True,
                text=True,
                timeout=LIMIT_S,
                check=True,
            ).stdout
            running.wait_for("gaps in ms", LIMIT_S)
    said = re.search(r"gaps in ms: (.*)", running.output)
    assert said is not None
    for gaps in map(ast.literal_eval, (heard, said[1])):
        # Every 10 ms by the clock of the simulation: a fifth as often as on the wall.
        assert gaps[len(gaps) // 2] == 10, gaps


@each_time("process")
def test_a_slow_tick_sees_its_own_time_though_the_clock_has_run_ahead(
    backend: str, tmp_path: Path
) -> None:
    done = launch(TICKS, "--backend", backend, cwd=tmp_path)
    assert done.exit_code == 0, done.output
    assert done.said("brain")[:5] == [f"at {tick / 10:.2f} s" for tick in range(1, 6)]
