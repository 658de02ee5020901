"""A camera without a display, in a container without rights: what another container sees of it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from launching import launch

from containers import nothing_left, require_containers

CAMERA = Path(__file__).parent / "camera"
RED, GREEN, BLUE = range(3)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    require_containers("neuros_mujoco", "neuros_python")
    with nothing_left(tmp_path):
        yield tmp_path


@pytest.mark.parametrize("opengl", ["egl", pytest.param("osmesa", marks=pytest.mark.acceptance)])
def test_images_at_30_hz_arrive_whole_and_none_is_lost(folder: Path, opengl: str) -> None:
    finished = launch(CAMERA, "--backend", "docker", cwd=folder, timeout_s=60.0, MUJOCO_GL=opengl)
    assert finished.exit_code == 0, finished.output
    assert finished.run_folder is not None
    seen = json.loads((finished.run_folder / "watcher" / "seen.json").read_text())
    assert seen == [{"bytes": 640 * 480 * 3, "colours": [RED, GREEN, BLUE]}] * len(seen)
    books = finished.connection("robot.image -> watcher.image")
    assert len(seen) == books["consumed"] >= 30
    assert (books["sent"], books["lost"]) == (books["received"], 0)
    assert "Read-only file system" not in finished.output, "no library complains"
