"""Nodes that compute and render on a GPU: for machines that have one, with PyTorch and MuJoCo.

``python -m pytest -m acceptance tests/acceptance/test_gpu_acceptance.py``
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from pathlib import Path

import pytest
from endings import GONE_WITHIN_S
from launching import BACKENDS, Finished, launch, start
from needs import cannot_run

from neuros.cli.main import main
from neuros.doctor.checks import _gpu, prove_rendering
from neuros.ports import FindingState

pytestmark = pytest.mark.acceptance

PROJECT = Path(__file__).parent / "on_the_gpu/project.json"
TIMEOUT_S = 120.0
HELD_MB = 4000


@pytest.fixture(scope="module", autouse=True)
def gpu() -> str:
    """The name of the first GPU."""
    if shutil.which("nvidia-smi") is None:
        cannot_run("a GPU")
    if not pytest.importorskip("torch").cuda.is_available():
        cannot_run("PyTorch with CUDA")
    return of_the_gpu("name")


def of_the_gpu(what: str) -> str:
    command = ["nvidia-smi", f"--query-gpu={what}", "--format=csv,noheader,nounits", "--id=0"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def run_of(folder: Path, back_end: str) -> Finished:
    run = launch(PROJECT, "--backend", back_end, "--digests", cwd=folder, timeout_s=TIMEOUT_S)
    assert run.exit_code == 0, run.output
    return run


@pytest.mark.parametrize("back_end", BACKENDS)
def test_a_network_on_the_gpu_turns_a_camera_towards_a_ball(
    gpu: str, back_end: str, tmp_path: Path
) -> None:
    first = run_of(tmp_path, back_end)

    assert f"computes on {gpu}" in first.output
    side = re.search(r"the ball is at (\S+)", first.output)
    assert side is not None
    assert abs(float(side[1])) < 0.02
    for name in ("robot.image -> brain.image", "brain.turn -> robot.turn"):
        connection = first.connection(name)
        assert connection["sent"] >= 200
        assert connection["lost"] == 0
    assert main(["verify", str(first.run_folder), str(run_of(tmp_path, "process").run_folder)]) == 0


def test_cameras_render_on_the_gpu() -> None:
    found = prove_rendering({**os.environ, "MUJOCO_GL": "egl"})
    assert found.state == FindingState.GOOD
    assert "NVIDIA" in found.text


def test_doctor_names_the_gpu(gpu: str) -> None:
    assert gpu in _gpu().text


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGINT])
def test_a_run_that_is_ended_gives_the_gpus_memory_back(ending: int, tmp_path: Path) -> None:
    before = int(of_the_gpu("memory.used"))
    held = ("--set", f"nodes.brain.environment.MEGABYTES={HELD_MB}")
    endless = ("--set", "nodes.brain.environment.IMAGES=0")
    with start(PROJECT, *held, *endless, cwd=tmp_path) as running:
        running.wait_for("computes on", TIMEOUT_S)
        assert int(of_the_gpu("memory.used")) >= before + HELD_MB
        brain = re.search(r"process (\d+) computes", running.output)
        assert brain is not None
        if ending == signal.SIGKILL:
            os.kill(int(brain[1]), ending)
        else:
            running.signal(ending)
        ended = running.finish(GONE_WITHIN_S)
    assert ended.exit_code == (130 if ending == signal.SIGINT else 1), ended.output
    assert int(of_the_gpu("memory.used")) < before + HELD_MB
