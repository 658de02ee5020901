"""What killed runs leave in shared memory goes, and what lives is never touched."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
from array import array
from pathlib import Path

import pytest

from neuros.launch.dead_runs import hold, remove_dead_runs
from neuros.launch.run_processes import RUN_ID
from neuros.transport.packet_segment import SegmentWriter


@pytest.fixture
def run() -> str:
    """The id of a run that does not exist."""
    return secrets.token_hex(8)


def remove(folder: Path) -> tuple[str, ...]:
    return remove_dead_runs(folder, look_again_s=0.0)


def test_the_folder_of_containers_goes_with_what_is_in_it(tmp_path: Path, run: str) -> None:
    (tmp_path / f"neuros_{run}").mkdir()
    (tmp_path / f"neuros_{run}" / "fastrtps_1").touch()
    assert remove(tmp_path) == (f"neuros_{run}",)
    assert list(tmp_path.iterdir()) == []


def test_it_stays_while_its_launcher_holds_it(tmp_path: Path, run: str) -> None:
    folder = tmp_path / f"neuros_{run}"
    folder.mkdir()
    descriptor = hold(folder)
    assert remove(tmp_path) == ()
    os.close(descriptor)
    assert remove(tmp_path) == (folder.name,)


def test_large_packets_stay_while_their_sender_has_mapped_them(tmp_path: Path, run: str) -> None:
    writer = SegmentWriter(f"{run}_camera", slots=2, folder=tmp_path)
    writer.write([array("B", bytes(100))])
    (segment,) = tmp_path.iterdir()
    assert remove(tmp_path) == ()
    copy = tmp_path / f"neuros_{run}_of_one_that_was_killed"
    copy.write_bytes(segment.read_bytes())
    assert remove(tmp_path) == (copy.name,)
    assert list(tmp_path.iterdir()) == [segment]
    writer.close()


def test_nothing_goes_while_a_process_of_the_run_is_there(tmp_path: Path, run: str) -> None:
    (tmp_path / f"neuros_{run}").mkdir()
    with subprocess.Popen(
        [sys.executable, "-c", "input()"],
        stdin=subprocess.PIPE,
        env={**os.environ, RUN_ID: run},
    ) as node:
        assert remove(tmp_path) == ()
        node.communicate(b"\n")
    assert remove(tmp_path) == (f"neuros_{run}",)


def test_what_is_called_differently_is_left_alone(tmp_path: Path, run: str) -> None:
    for name in (f"my_neuros_{run}", f"neuros_{run[:8]}", f"neuros_{run}s", "neuros_lock"):
        (tmp_path / name).touch()
    assert remove(tmp_path) == ()


def test_what_was_made_anew_between_two_looks_stays(
    tmp_path: Path, run: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / f"neuros_{run}"
    folder.mkdir()

    def make_anew(_: float) -> None:
        folder.rename(tmp_path / "aside")
        folder.mkdir()

    monkeypatch.setattr("time.sleep", make_anew)
    assert remove(tmp_path) == ()


def test_a_folder_that_does_not_exist_is_clean(tmp_path: Path) -> None:
    assert remove(tmp_path / "nowhere") == ()
