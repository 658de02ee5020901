"""The vehicle of the example light with a network in PyNN, in the environment of its container."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import neuros
from launching import EXAMPLES, Finished, launch

from containers import nothing_left, require_containers

pytest.importorskip("nest")

PROJECT = EXAMPLES / "4_neurorobotics/light/pynn.json"
TIMEOUT_S = 240.0


def run(folder: Path, backend: str, heading_deg: int) -> Finished:
    """Run it to its end; the first run on a machine makes the environment."""
    folder.mkdir(exist_ok=True)
    done = launch(
        PROJECT,
        *("--backend", backend, "--digests"),
        *("--set", f"nodes.vehicle.environment.HEADING={heading_deg}"),
        cwd=folder,
        timeout_s=TIMEOUT_S,
    )
    assert done.exit_code == 0, done.output
    return done


def verdict(one: Finished, other: Finished) -> str:
    """What ``neuros verify`` says of two runs."""
    done = neuros("verify", one.run_folder, other.run_folder)
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A vehicle that looks away from the light."""
    return run(tmp_path_factory.mktemp("first"), "process", 120)


def check_that_it_found_the_light(finished: Finished) -> None:
    assert finished.record["nodes"]["vehicle"]["results"]["distance_m"] < 0.25
    books = finished.connection("brain.spikes -> vehicle.spikes")
    assert books["sent"] == books["received"] > 100


def test_the_vehicle_finds_the_light(first: Finished) -> None:
    check_that_it_found_the_light(first)


@pytest.mark.acceptance
def test_it_finds_it_on_its_other_side_too(tmp_path: Path) -> None:
    check_that_it_found_the_light(run(tmp_path, "process", -90))


def test_the_same_seed_gives_the_same_spikes(first: Finished, tmp_path: Path) -> None:
    assert "identical" in verdict(first, run(tmp_path / "again", "process", 120))


@pytest.mark.acceptance
def test_its_container_is_built_and_gives_the_same_spikes(first: Finished, tmp_path: Path) -> None:
    require_containers("neuros_python")
    build = [sys.executable, "-m", "neuros.cli", "containers", "build", str(PROJECT)]
    if authorities := os.environ.get("PIP_CERT"):
        build += ["--ca-bundle", authorities]
    done = subprocess.run(build, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with nothing_left(tmp_path):
        contained = run(tmp_path / "run", "docker", 120)
    assert "identical" in verdict(first, contained)
