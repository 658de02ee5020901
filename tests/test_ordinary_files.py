"""Files in folders that others may write to: nothing is written elsewhere through a link."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from neuros.ordinary_files import (
    cannot_be_opened,
    open_new,
    open_ordinary,
    write_whole,
)
from neuros.recording.recorder import counts_of
from neuros.recording.run_file import write_run_file


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A file elsewhere, which has to stay as it is."""
    file = tmp_path / "elsewhere.txt"
    file.write_text("mine")
    return file


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    return folder


def through_new(path: Path) -> None:
    with open_new(path) as file:
        file.write(b"ours")


def through_whole(path: Path) -> None:
    write_whole(path, b"ours")


WAYS = pytest.mark.parametrize("write", [through_new, through_whole])


@WAYS
@pytest.mark.parametrize("name", ["x", ".x"])
def test_what_is_written_takes_the_place_of_a_link(
    run: Path, victim: Path, write: Callable[[Path], None], name: str
) -> None:
    (run / name).symlink_to(victim)
    write(run / "x")
    assert victim.read_text() == "mine"
    assert (run / "x").read_text() == "ours"
    assert not (run / "x").is_symlink()


@WAYS
def test_a_folder_stays_and_is_named(run: Path, write: Callable[[Path], None]) -> None:
    (run / "x").mkdir()
    with pytest.raises(IsADirectoryError, match="x"):
        write(run / "x")
    assert [each.name for each in run.iterdir()] == ["x"]


@WAYS
def test_a_new_file_has_the_mode_of_any_other(run: Path, write: Callable[[Path], None]) -> None:
    (run / "ordinary").touch()
    write(run / "x")
    modes = {stat.S_IMODE((run / name).stat().st_mode) for name in ("ordinary", "x")}
    assert len(modes) == 1


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (os.mkfifo, "it is not an ordinary file"),
        (lambda path: os.symlink("/dev/zero", path), "it is not an ordinary file"),
        (os.mkdir, "Is a directory"),
    ],
)
def test_only_files_are_read(run: Path, make: Callable[[Path], None], said: str) -> None:
    make(run / "x")
    with pytest.raises(OSError, match=said):
        open_ordinary(run / "x")


# ---------------------------------------------------------------------- in a run folder


def test_a_node_cannot_have_the_record_written_elsewhere(run: Path, victim: Path) -> None:
    for name in ("run.json", ".run.json"):
        (run / name).symlink_to(victim)
    write_run_file({"reason": "done"}, run)
    assert victim.read_text() == "mine"
    assert "done" in (run / "run.json").read_text()


def test_no_recorder_waits_for_a_pipe_that_a_node_has_left(run: Path) -> None:
    (run / "bag").mkdir()
    os.mkfifo(run / "bag/metadata.yaml")
    with pytest.raises(OSError, match="it is not an ordinary file"):
        counts_of(run)


def test_who_has_no_access_learns_to_what_and_whose_it_is(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    owner = tmp_path.owner()
    for path, named in ((file, file), (tmp_path / "new", tmp_path)):
        error = PermissionError(errno.EACCES, "Permission denied", str(path))
        assert cannot_be_opened(error) == (
            f"{path} cannot be opened (Permission denied): you have no access to {named}, which"
            f" belongs to {owner}"
        )
