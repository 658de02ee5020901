"""The project of the page about time: its ticks, on two back ends and in a replay."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from launching import REPOSITORY, Finished, launch
from replaying import Recorded, assert_identical, replay

from neuros.cli.main import main

_FILE = re.compile(r"^`([\w.]+)`:\n\n```\w+\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("turntable")
    page = (REPOSITORY / "docs" / "time.md").read_text("utf-8")
    for name, text in _FILE.findall(page):
        (folder / name).write_text(text)
    return folder


def run(project: Path, folder: Path, backend: str) -> Finished:
    folder.mkdir(exist_ok=True)
    done = launch(project, "--backend", backend, "-r", "--duration", "0.5sim", cwd=folder)
    assert done.exit_code == 0, done.output
    assert done.run_folder is not None
    return done


@pytest.fixture(scope="module")
def in_process(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return run(project, tmp_path_factory.mktemp("runs"), "in-process")


def test_a_tick_sees_the_time_and_the_measurement_of_that_time(in_process: Finished) -> None:
    found = [line for line in in_process.said("world") if "rad" in line]
    # The world ends the run at 0.5 s, so it does not start on the last one.
    assert found == [f"{t / 10} s: {t * 0.15:.2f} rad" for t in (1, 2, 3, 4)]
    hooks = in_process.record["nodes"]["brain"]["hooks"]
    assert hooks["estimate"]["executions"] == 5
    assert hooks["estimate"]["missed_ticks"] == 0
    clock = in_process.connection("world.clock -> brain.clock")
    assert clock["sent"] == clock["consumed"] == 25


def test_replayed_it_ticks_as_in_the_run(in_process: Finished, project: Path) -> None:
    assert in_process.run_folder is not None
    recorded = Recorded(project, in_process.run_folder)
    done = replay(recorded.run, "brain")
    assert done.returncode == 0, done.stderr
    assert_identical(recorded, "brain", done.stdout)


@pytest.mark.acceptance
def test_processes_send_the_very_packets(
    in_process: Finished, project: Path, tmp_path: Path
) -> None:
    other = run(project, tmp_path / "process", "process")
    assert main(["verify", str(in_process.run_folder), str(other.run_folder)]) == 0
