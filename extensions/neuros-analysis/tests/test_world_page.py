"""The page of a recorded world: from the file that a node writes to one file of HTML."""

from __future__ import annotations

import base64
import json
import os
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from neuros_analysis import run_pages
from neuros_analysis.review import ReviewedRun

from neuros.node.logs import WORLD_LOG, WorldLog

POSE = base64.b64encode(bytes(28))


class World:
    """A world of one body, at x in metres."""

    def __init__(self) -> None:
        self.version = "1"
        self.frames: list[list[Any]] = []

    def at(self, sim_s: float, x: float) -> None:
        pose = np.array([x, 0, 0, 1, 0, 0, 0], "<f4").tobytes()
        self.frames.append([0.0, sim_s, base64.b64encode(pose).decode()])

    def look(self, wanted: Mapping[str, Any], asker: int) -> dict[str, Any]:
        found: dict[str, Any] = {"version": self.version}
        if wanted.get("frames"):
            found["frames"], self.frames = self.frames, []
        if wanted.get("geometry"):
            found["geometry"] = json.dumps({"name": f"</script> {self.version}"})
        return found


class Logger:
    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warning(self, text: str) -> None:
        self.warnings.append(text)


@pytest.fixture
def run(tmp_path: Path) -> ReviewedRun:
    (tmp_path / "robot").mkdir()
    return ReviewedRun(tmp_path, {"nodes": {"robot": {}, "brain": {}}})


@pytest.fixture
def log(run: ReviewedRun) -> WorldLog:
    return WorldLog(run.folder / "robot", Logger())  # type: ignore[arg-type]


def fail(complaint: str) -> None:
    raise AssertionError(complaint)


def scenes(run: ReviewedRun, complain: Callable[[str], object] = fail) -> list[dict[str, Any]]:
    """What the page of the robot holds."""
    found = run_pages.world_pages(run, complain)
    assert [*found] == ["robot"]
    text = found["robot"].partition('<script type="application/json" id="scenes">')[2]
    found: list[dict[str, Any]] = json.loads(text.partition("</script>")[0])
    for scene in found:
        poses = np.frombuffer(zlib.decompress(base64.b64decode(scene["poses"])), "<f4")
        scene["x"] = poses.reshape(-1, 7)[:, 0].tolist()
    return found


def test_a_run_without_a_recorded_world_has_no_page(run: ReviewedRun) -> None:
    assert run_pages.world_pages(run) == {}


def test_frames_are_in_their_order_and_geometry_is_kept_once(
    run: ReviewedRun, log: WorldLog
) -> None:
    world = World()
    for bundle in range(3):
        world.at(bundle, bundle), world.at(bundle + 0.5, bundle + 0.5)
        log.write(world.look)
    (scene,) = scenes(run)
    assert scene["geometry"] == {"name": "</script> 1"}
    assert scene["times_s"] == scene["x"] == [0, 0.5, 1, 1.5, 2, 2.5]
    assert (run.folder / "robot" / WORLD_LOG).read_text().count("geometry") == 1


def test_each_geometry_has_its_own_frames(run: ReviewedRun, log: WorldLog) -> None:
    world = World()
    for sim_s, world.version in enumerate(("1", "2", "1")):
        world.at(sim_s, sim_s)
        log.write(world.look)
    found = scenes(run)
    assert [scene["geometry"]["name"][-1] for scene in found] == ["1", "2", "1"]
    assert [scene["x"] for scene in found] == [[0], [1], [2]]


def test_what_stands_still_is_one_frame_and_time_goes_on_after_a_reset(
    run: ReviewedRun, log: WorldLog
) -> None:
    world = World()
    for sim_s in (0, 1, 1, 1, 2, 0.5, 1.5):
        world.at(sim_s, sim_s)
    log.write(world.look)
    (scene,) = scenes(run)
    assert scene["times_s"] == [0, 1, 2, 2.5, 3.5]
    assert scene["x"] == [0, 1, 2, 0.5, 1.5]


def test_of_a_long_recording_every_kth_frame_is_shown(
    run: ReviewedRun, log: WorldLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_pages, "MOST_FRAMES", 4)
    world = World()
    for number in range(10):
        world.at(number, number)
    log.write(world.look)
    assert scenes(run)[0]["x"] == [0, 3, 6, 9]


@pytest.mark.parametrize(
    "line",
    [
        b'{"version": "1", "fra',
        b'{"version": "\xc3',
        b"5",
        b"[1]",
        b'{"geometry": "{}"}',
        b'{"geometry": "x", "frames": []}',
        b'{"geometry": "[]", "frames": []}',
        b'{"geometry": "{\\"size\\": NaN}", "frames": []}',
        b'{"geometry": 5, "frames": []}',
        b'{"frames": 5}',
        b'{"frames": [[0, 1.0]]}',
        b'{"frames": [[0, 1.0, "A"]]}',
        b'{"frames": [[0, 1.0, "AAAA"]]}',
        b'{"frames": [[0, "1", "%s"]]}' % POSE,
        b'{"frames": [[0, NaN, "%s"]]}' % POSE,
        b'{"frames": [[0, 1%s, "%s"]]}' % (b"0" * 400, POSE),
        b"[" * 200_000,
        b'{"geometry": "%s", "frames": []}' % (b"[" * 200_000),
    ],
    ids=lambda line: line[:40].decode("ascii", "replace"),
)
def test_what_comes_before_a_damage_is_shown_and_the_damage_is_named(
    run: ReviewedRun, log: WorldLog, line: bytes
) -> None:
    world = World()
    world.at(0, 0)
    log.write(world.look)
    with (run.folder / "robot" / WORLD_LOG).open("ab") as file:
        file.write(line)
    complaints: list[str] = []
    assert scenes(run, complaints.append)[0]["x"] == [0]
    assert complaints == [f"the rest of {run.folder / 'robot' / WORLD_LOG}: the file is damaged"]


def test_a_world_without_frames_has_no_page(run: ReviewedRun) -> None:
    (run.folder / "robot" / WORLD_LOG).write_text('{"geometry": "{}", "frames": []}')
    assert run_pages.world_pages(run, fail) == {}


def test_frames_without_a_geometry_are_no_world(run: ReviewedRun) -> None:
    complaints: list[str] = []
    (run.folder / "robot" / WORLD_LOG).write_text('{"frames": [[0, 1.0, "AAAA"]]}')
    assert run_pages.world_pages(run, complaints.append) == {}
    assert len(complaints) == 1


def test_a_world_is_a_file_and_no_pipe(run: ReviewedRun) -> None:
    complaints: list[str] = []
    os.mkfifo(run.folder / "robot" / WORLD_LOG)
    assert run_pages.world_pages(run, complaints.append) == {}
    assert len(complaints) == 1


def test_a_world_that_cannot_be_recorded_is_told_once_and_ends_no_run(tmp_path: Path) -> None:
    logger = Logger()
    log = WorldLog(tmp_path / "gone", logger)  # type: ignore[arg-type]
    for _ in range(3):
        log.write(World().look)
    (warning,) = logger.warnings
    assert "the world is not recorded any more" in warning
