"""WhiskEye with messages of its own: the same estimates as with those of ROS, on all back ends."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from launching import BACKENDS, EXAMPLES, Finished, launch
from needs import COMPILER

import neuros.bag
from containers import require_containers

pytestmark = [pytest.mark.acceptance, pytest.mark.needs(*COMPILER, "OpenGL")]

WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
SECONDS, PACKETS = 20, 1000
TIMEOUT_S = 400.0


def run_of(project: str, node: str, folder: Path, back_end: str, *arguments: str) -> Finished:
    duration = ("--set", f"nodes.{node}.environment.DURATION={SECONDS}")
    options = ("--backend", back_end, *duration, *arguments)
    run = launch(WHISKEYE / project, *options, cwd=folder, timeout_s=TIMEOUT_S)
    assert run.exit_code == 0, run.output
    return run


def series(run: Finished) -> bytes:
    """Estimates and truths with every digit."""
    assert run.run_folder is not None
    return (run.run_folder / "visualiser" / "head_direction.csv").read_bytes()


@pytest.fixture(scope="module")
def strict(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """What the variant with messages of ROS finds."""
    return series(run_of("strict.json", "robot", tmp_path_factory.mktemp("strict"), "process"))


@pytest.mark.parametrize("back_end", [*BACKENDS, "docker"])
def test_body_and_brain_find_the_same_heading(strict: bytes, back_end: str, tmp_path: Path) -> None:
    if back_end == "docker":
        require_containers("neuros_python", "neuros_mujoco", "neuros_nest")

    run = run_of("custom_messages.json", "body", tmp_path, back_end, "-t", "body.senses")

    assert series(run) == strict
    error = json.loads((run.run_folder / "visualiser" / "head_direction.json").read_text())
    assert error["rms_deg"] <= 5.0
    assert error["max_deg"] <= 12.0
    assert run.connection("brain.commands -> body.commands")["sent"] == PACKETS + 1
    with neuros.bag.open(run.run_folder) as bag:
        senses = [message for _, message in bag["body.senses"].messages()]
    assert len(senses) == PACKETS + 1
    seen = [message for message in senses if message.left_camera.width]
    assert len(seen) == SECONDS * 5
    for camera in (seen[0].left_camera, seen[0].right_camera, seen[0].body_camera):
        assert (camera.width, camera.height, len(camera.data)) == (160, 120, 160 * 120 * 3)
    assert senses[-1].positions.names == ["pose_x", "pose_y", "pose_z"]
    turned = dict(zip(senses[-1].rotations.names, senses[-1].rotations.values, strict=True))
    assert turned["pose_theta"] == pytest.approx(SECONDS, abs=0.05)
    assert len(turned) == 28
