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
    folder_in,
    open_log,
    open_new,
    open_ordinary,
    write_whole,
)
from neuros.recording.bag_writer import BagWriter
from neuros.recording.recorder import counts_of
from neuros.recording.recording_plan import RecordedStream, Topic
from neuros.recording.run_file import write_run_file
from neuros.recording.spool import ListenedSpool, SpoolReader, SpoolWriter


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


def through_log(path: Path) -> None:
    with open_log(path) as file:
        file.write(b"ours")


def through_whole(path: Path) -> None:
    write_whole(path, b"ours")


WAYS = pytest.mark.parametrize("write", [through_new, through_log, through_whole])


@pytest.mark.parametrize("write", [through_new, through_whole])
@pytest.mark.parametrize("name", ["x", ".x"])
def test_what_is_written_takes_the_place_of_a_link(
    run: Path, victim: Path, write: Callable[[Path], None], name: str
) -> None:
    (run / name).symlink_to(victim)
    write(run / "x")
    assert victim.read_text() == "mine"
    assert (run / "x").read_text() == "ours"
    assert not (run / "x").is_symlink()


def test_a_log_does_not_go_on_behind_a_link(run: Path, victim: Path) -> None:
    (run / "x").symlink_to(victim)
    with pytest.raises(OSError, match="symbolic link"):
        open_log(run / "x")
    assert victim.read_text() == "mine"


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


def test_a_log_goes_on(run: Path) -> None:
    through_log(run / "x")
    through_log(run / "x")
    assert (run / "x").read_text() == "oursours"


def test_a_folder_is_found_and_made(run: Path) -> None:
    with folder_in(run, "a", "b", makes=True) as folder:
        (folder / "x").touch()
    with folder_in(run, "a") as folder:
        assert [*os.listdir(folder / "b")] == ["x"]
    with pytest.raises(FileNotFoundError, match="c"), folder_in(run, "a", "c"):
        pass


@pytest.mark.parametrize("names", [("link",), ("link", "below"), ("own", "link")])
def test_no_folder_is_found_or_made_through_a_link(
    run: Path, tmp_path: Path, names: tuple[str, ...]
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (run / "own").mkdir()
    (run / "link").symlink_to(elsewhere)
    (run / "own/link").symlink_to(elsewhere)
    with pytest.raises(NotADirectoryError, match="link"), folder_in(run, *names, makes=True):
        pass
    assert not [*elsewhere.iterdir()]


def test_a_folder_stays_the_same_whatever_takes_its_name(run: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    with folder_in(run, "own", makes=True) as folder:
        (run / "own").rename(run / "former")
        (run / "own").symlink_to(elsewhere)
        through_whole(folder / "x")
    assert (run / "former/x").read_text() == "ours"
    assert not [*elsewhere.iterdir()]


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


def test_a_node_cannot_have_the_list_of_topics_written_elsewhere(run: Path, victim: Path) -> None:
    (run / ".listener").mkdir()
    for name in ("topics.json", ".topics.json", "topics.json.new"):
        (run / ".listener" / name).symlink_to(victim)
    ListenedSpool(run).add(Topic("/x", "std_msgs/msg/String"))
    assert victim.read_text() == "mine"


def linked(folder: Path, elsewhere: Path) -> None:
    """Put a link to another folder in the place of a folder."""
    if folder.exists():
        folder.rename(folder.with_name("former"))
    folder.symlink_to(elsewhere)


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    """A folder that has to stay as it is."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "00000000").write_text("mine")
    return folder


def is_as_it_was(elsewhere: Path) -> bool:
    return [(path.name, path.read_text()) for path in elsewhere.iterdir()] == [("00000000", "mine")]


@pytest.mark.parametrize("name", [".listener", ".listener/spool"])
def test_a_node_cannot_have_packets_kept_in_another_folder(
    run: Path, elsewhere: Path, name: str
) -> None:
    (run / name).parent.mkdir(exist_ok=True)
    linked(run / name, elsewhere)
    spool = ListenedSpool(run)
    with pytest.raises(NotADirectoryError, match=name):
        spool.keep(spool.add(Topic("/x", "std_msgs/msg/String")), 0, b"")
    assert is_as_it_was(elsewhere)


def test_a_node_cannot_have_the_bag_written_elsewhere(run: Path, elsewhere: Path) -> None:
    bag = BagWriter(run / "bag", {})
    linked(run / "bag", elsewhere)
    with pytest.raises(NotADirectoryError, match="bag"):
        bag.close()
    assert is_as_it_was(elsewhere)


@pytest.mark.parametrize("name", ["node", "node/spool"])
def test_a_node_cannot_have_files_removed_elsewhere(run: Path, elsewhere: Path, name: str) -> None:
    (elsewhere / "spool").symlink_to(elsewhere)
    spool = SpoolWriter(run / "node", [RecordedStream("sent", "x", (0,))])
    spool.keep(0, b"", None)
    spool.close()
    reader = SpoolReader(run / "node")
    assert reader.read(1000)[0]
    linked(run / name, elsewhere)
    reader.close(remove=True)
    (elsewhere / "spool").unlink()
    assert is_as_it_was(elsewhere)


def test_a_node_cannot_have_files_read_elsewhere(run: Path, victim: Path) -> None:
    (run / "node/spool").mkdir(parents=True)
    (run / "node/spool/00000000").symlink_to(victim)
    with pytest.raises(OSError, match="symbolic link"):
        SpoolReader(run / "node").read(1)


def test_no_recorder_waits_for_a_pipe_that_a_node_has_left(run: Path) -> None:
    for name in ("spool/00000000", "bag/metadata.yaml"):
        (run / name).parent.mkdir(exist_ok=True)
        os.mkfifo(run / name)
    with pytest.raises(OSError, match="it is not an ordinary file"):
        SpoolReader(run).read(1)
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
