"""WhiskEye's ring in Nengo, in the environment that the launcher makes of its container."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from launching import EXAMPLES, Finished, launch

from containers import nothing_left, require_containers

pytest.importorskip("mujoco")

WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
SECONDS, PACKETS_PER_S = 2, 50
TIMEOUT_S = 240.0
CONNECTIONS = (
    "robot.imu -> snn.imu",
    "robot.pose -> visualiser.truth",
    "snn.estimate -> visualiser.estimate",
)

PROGRAM = """
import json, math
from nengo_ring import NengoRing

def headings(rate_rad_s, steps, seed=1):
    ring = NengoRing(seed)
    settled = ring.settle()
    return [settled, *(ring.step(rate_rad_s, 0.02) for _ in range(steps))]

def refused(duration_s):
    try:
        NengoRing().step(0.0, duration_s)
    except ValueError as error:
        return str(error)

ends = []
for lengths in ([0.02] * 10, [0.1, 0.06, 0.02, 0.02]):
    ring = NengoRing()
    ring.settle()
    ends.append([ring.step(1.0, length) for length in lengths][-1])
print(json.dumps({
    "left": headings(1.0, 150), "right": headings(-1.0, 150), "still": headings(0.0, 100),
    "again": headings(1.0, 20), "other seed": headings(1.0, 20, seed=2),
    "ends": ends, "refused": [refused(length) for length in (0.0, 0.0205, -0.02)],
}))
"""


def run(folder: Path, backend: str, *settings: str) -> Finished:
    """Run the project to its end, without windows."""
    folder.mkdir(exist_ok=True)
    arguments = [argument for each in settings for argument in ("--set", f"nodes.{each}")]
    done = launch(
        WHISKEYE / "nengo.json",
        *("--backend", backend, *arguments),
        cwd=folder,
        timeout_s=TIMEOUT_S,
        NEUROS_GUI="0",
    )
    assert done.exit_code == 0, done.output
    return done


def error_of(done: Finished) -> dict[str, float]:
    return dict(json.loads((done.run_folder / "visualiser/head_direction.json").read_text()))


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A run of the project; the first one on a machine makes the environment."""
    folder = tmp_path_factory.mktemp("short")
    return run(folder, "process", f"robot.environment.DURATION={SECONDS}")


@pytest.fixture(scope="module")
def told(short: Finished) -> dict[str, list[float]]:
    """What the ring told, alone, in the environment of its node."""
    done = subprocess.run(
        [short.record["versions"]["nodes"]["snn"]["executable"], "-c", PROGRAM],
        env={**os.environ, "PYTHONPATH": str(WHISKEYE)},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


def test_the_experiment_loses_nothing_and_tracks_the_heading(short: Finished) -> None:
    for name in CONNECTIONS:
        found = short.connection(name)
        assert found["sent"] == found["consumed"] == SECONDS * PACKETS_PER_S, name
    assert error_of(short)["rms_deg"] <= 5
    assert error_of(short)["max_deg"] <= 12
    assert (short.run_folder / "visualiser/head_direction.png").read_bytes().startswith(b"\x89PNG")


def test_it_follows_a_turn_to_either_side(told: dict[str, list[float]]) -> None:
    for name, sign in (("left", 1), ("right", -1)):
        assert np.unwrap(told[name])[-1] == pytest.approx(3.0 * sign, abs=math.radians(12))


def test_it_starts_at_zero_and_holds(told: dict[str, list[float]]) -> None:
    assert told["still"][0] == 0.0
    held_deg = np.degrees(told["still"][1:])
    assert np.max(np.abs(held_deg)) < 8
    assert abs(np.mean(held_deg[50:]) - np.mean(held_deg[:50])) < 0.5


def test_it_repeats_itself_and_another_seed_is_another_network(
    told: dict[str, list[float]],
) -> None:
    assert told["again"] == told["left"][:21] != told["other seed"]


def test_the_length_of_the_steps_does_not_change_the_spikes(told: dict[str, list[float]]) -> None:
    first, second = told["ends"]
    assert first == second


def test_a_step_that_is_no_whole_number_of_quanta_is_refused(told: dict[str, list[str]]) -> None:
    assert len(told["refused"]) == 3
    assert all("whole number of 1 ms" in refusal for refusal in told["refused"])


# ------------------------------------------------------------------ as long as published


@pytest.mark.acceptance
@pytest.mark.parametrize("rate", ["1.0", "-1.0"])
@pytest.mark.parametrize("seed", ["1", "2", "3"])
def test_it_is_as_accurate_as_in_nest(tmp_path: Path, seed: str, rate: str) -> None:
    settings = (f"robot.environment.RATE={rate}", f"snn.environment.SEED={seed}")
    found = error_of(run(tmp_path, "process", *settings))
    assert found["samples"] == 20 * PACKETS_PER_S
    assert found["rms_deg"] <= 5
    assert found["max_deg"] <= 12
    assert found["gain"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.acceptance
def test_a_biased_gyroscope_leads_it_astray_too(tmp_path: Path) -> None:
    found = error_of(run(tmp_path, "process", "snn.environment.GYRO_BIAS=0.1"))
    assert found["rms_deg"] > 50
    assert 95 <= found["max_deg"] <= 130


@pytest.mark.acceptance
def test_its_container_is_built_and_has_the_same_estimates_bit_for_bit(
    short: Finished, tmp_path: Path
) -> None:
    require_containers("neuros_python", "neuros_mujoco")
    build = [
        sys.executable,
        "-m",
        "neuros.cli",
        "containers",
        "build",
        str(WHISKEYE / "nengo.json"),
    ]
    if authorities := os.environ.get("PIP_CERT"):
        build += ["--ca-bundle", authorities]
    done = subprocess.run(build, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with nothing_left(tmp_path):
        contained = run(tmp_path / "run", "docker", f"robot.environment.DURATION={SECONDS}")
    tables = [
        (each.run_folder / "visualiser/head_direction.csv").read_bytes()
        for each in (short, contained)
    ]
    assert tables[0] == tables[1]
