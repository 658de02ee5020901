"""A bag that something has happened to: it reads as it was written, or says that it does not."""

from __future__ import annotations

import contextlib
import re
import shutil
import sqlite3
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import NUMBER, number, plan, spool

import neuros.bag
from neuros.api.verify import RecordedPackets
from neuros.bag import Bag
from neuros.cli.main import main
from neuros.errors import EnvironmentFault

VALUES = [*range(1, 201)]


def recorded(run: Path, storage: str = "mcap") -> Path:
    """The folder of a run with a bag."""
    plan(storage).save(run)
    spool(run, "a", [(value, None, number(value)) for value in VALUES])
    neuros.bag.open(run).close()
    return run


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def in_sqlite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("run"), "sqlite3")


def values_in(bag: Bag) -> list[int]:
    with bag:
        return [int(value) for value in bag[NUMBER.name].array()["data"]]


@settings(max_examples=200)
@given(st.sampled_from(["bag.mcap", "metadata.yaml"]), st.floats(0, 1), st.integers(1, 255))
def test_a_byte_that_has_changed_is_noticed_or_has_no_effect(
    whole: Path, name: str, where: float, change: int
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        shutil.copytree(whole / "bag", bag)
        data = bytearray((bag / name).read_bytes())
        data[int(where * (len(data) - 1))] ^= change
        (bag / name).write_bytes(data)
        try:
            found = values_in(Bag(bag, {}))
        except EnvironmentFault:
            return
    assert found == VALUES


def test_packets_that_are_not_as_they_were_written_are_not_taken_for_it(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    file = run / "bag" / "bag.mcap"
    data = file.read_bytes()
    file.write_bytes(data.replace(number(100), number(999)))
    with pytest.raises(EnvironmentFault, match=r"bag\.mcap is damaged between bytes \d+ and \d+"):
        values_in(neuros.bag.open(run))
    assert main(["bag", "info", str(run)]) == 4
    assert "is damaged between bytes" in capsys.readouterr().err
    kept = tmp_path / "kept"
    shutil.copytree(run, kept)
    assert main(["bag", "repair", str(run)]) == 4
    said = capsys.readouterr().err
    assert "is damaged between bytes" in said
    assert f"{2 * len(VALUES)} packets, any of which may have changed, are left out" in said
    assert values_in(neuros.bag.open(run)) == []
    assert (run / "bag.before_repair/bag.mcap").exists()

    assert main(["bag", "repair", str(kept), "--keep-changed"]) == 4
    assert "any of which may have changed, are kept" in capsys.readouterr().err
    assert values_in(neuros.bag.open(kept)) == [999 if value == 100 else value for value in VALUES]


def test_only_packets_of_the_part_that_has_changed_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    plan().save(run)
    values = [*range(1, 100_001)]
    values[50_000] = 123_456_789
    spool(run, "a", [(at, None, number(value)) for at, value in enumerate(values, 1)])
    neuros.bag.open(run).close()
    file = run / "bag" / "bag.mcap"
    data = file.read_bytes()
    assert data.count(number(123_456_789)) == 2, "the output has two connections"
    file.write_bytes(data.replace(number(123_456_789), number(-1)))
    assert main(["bag", "repair", str(run)]) == 4
    assert "any of which may have changed, are left out" in capsys.readouterr().err
    left = values_in(neuros.bag.open(run))
    assert set(left) < {*values} - {123_456_789}
    assert len(left) > 50_000
    assert left == sorted(left)


def test_a_length_that_is_wrong_takes_no_memory_and_costs_no_packet(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    file = run / "bag" / "bag.mcap"
    data = bytearray(file.read_bytes())
    chunk = first_chunk(run)
    data[chunk + 1 : chunk + 9] = (1 << 62).to_bytes(8, "little")
    file.write_bytes(data)
    with pytest.raises(EnvironmentFault, match="is damaged between bytes"):
        values_in(neuros.bag.open(run))
    assert main(["bag", "repair", str(run)]) == 0
    assert "is damaged between bytes" in capsys.readouterr().err
    assert values_in(neuros.bag.open(run)) == VALUES


def test_a_wrong_length_of_the_first_record_costs_no_packet(whole: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    damage_header(run)
    assert main(["bag", "info", str(run)]) == 0  # completes it
    assert values_in(neuros.bag.open(run)) == VALUES


def test_a_repair_keeps_the_damaged_bag(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    damaged = damage_header(run)
    assert main(["bag", "repair", str(run)]) == 0
    kept = run / "bag.before_repair"
    assert f"the damaged bag is kept in {kept}" in capsys.readouterr().err
    assert (kept / "bag.mcap").read_bytes() == damaged


@pytest.mark.parametrize(
    ("of_chunk", "at"),
    [
        pytest.param(False, 0, id="magic"),
        pytest.param(False, 9, id="length of the header"),
        pytest.param(True, 0, id="kind of a chunk"),
        pytest.param(True, 1, id="length of a chunk"),
        pytest.param(True, 25, id="length of its records"),
        pytest.param(True, 37, id="its compression"),
    ],
)
def test_a_byte_between_packets_costs_none(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], of_chunk: bool, at: int
) -> None:
    run = changed(whole, tmp_path, at + of_chunk * first_chunk(whole))
    assert main(["bag", "repair", str(run)]) == 0
    assert re.search("is damaged between bytes|does not begin as", capsys.readouterr().err)
    assert values_in(neuros.bag.open(run)) == VALUES


def test_packets_do_not_need_the_part_that_defines_their_topic(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = changed(whole, tmp_path, (whole / "bag/bag.mcap").read_bytes().index(b"/neuros/a"))
    assert main(["bag", "repair", str(run)]) == 0
    assert "is damaged between bytes" in capsys.readouterr().err
    assert values_in(neuros.bag.open(run)) == VALUES


@settings(max_examples=20)
@given(st.floats(0, 1), st.integers(1, 255))
def test_a_byte_of_an_sqlite_bag_that_has_changed_is_answered(
    in_sqlite: Path, where: float, change: int
) -> None:
    """It has no checksums: other packets than those that were recorded may come out of it."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        shutil.copytree(in_sqlite, run)
        file = run / "bag/bag.db3"
        data = bytearray(file.read_bytes())
        data[int(where * (len(data) - 1))] ^= change
        file.write_bytes(data)
        is_whole = main(["bag", "info", str(run)]) == 0
        try:
            found = values_in(neuros.bag.open(run))
        except EnvironmentFault:
            return
        assert len(found) == len(VALUES) or not is_whole


@pytest.mark.parametrize(
    ("old", "new"),
    [
        pytest.param(b"/neuros/a/number", b"/neuros/\xff/number", id="topic"),
        pytest.param(b"CREATE TABLE messages", b"CREATE TABLE nessages", id="table"),
        pytest.param(b"CREATE TABLE messages", b"\xffREATE TABLE messages", id="no text"),
        pytest.param(b"SQLite format 3", b"SQLite format 4", id="magic"),
    ],
)
def test_an_sqlite_bag_that_has_lost_packets_says_how_many(
    in_sqlite: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], old: bytes, new: bytes
) -> None:
    run = tmp_path / "run"
    shutil.copytree(in_sqlite, run)
    file = run / "bag/bag.db3"
    file.write_bytes(file.read_bytes().replace(old, new))
    other = shutil.copytree(run, tmp_path / "other")
    assert main(["bag", "info", str(run)]) == 4
    missing = f"200 of {NUMBER.name}|of 200 packets of {NUMBER.name} 0 are left"
    assert re.search(missing, capsys.readouterr().err)
    assert main(["bag", "repair", str(other)]) == 4
    lost = "packets that were recorded, and are not in the bag: 200 of"
    assert f"{lost} {NUMBER.name}" in capsys.readouterr().err
    assert (other / "bag.before_repair").is_dir()


def test_a_topic_that_has_got_the_name_of_another_is_noticed(whole: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    file = run / "bag" / "metadata.yaml"
    file.write_text(file.read_text().replace("number/b/number", "number/c/number"))
    with pytest.raises(EnvironmentFault, match="does not name the topic /neuros/a/number/b/"):
        values_in(Bag(run / "bag", {}))
    assert values_in(neuros.bag.open(run)) == VALUES, "which repairs it"


@pytest.mark.parametrize("new", [b"inq32 data", b"int32 ####", b"\xffnt32 data"])
def test_a_definition_that_has_changed_costs_no_packet(
    in_sqlite: Path, tmp_path: Path, new: bytes
) -> None:
    run = Path(shutil.copytree(in_sqlite, tmp_path / "run"))
    file = run / "bag/bag.db3"
    file.write_bytes(file.read_bytes().replace(b"int32 data", new))
    assert main(["bag", "repair", str(run)]) == 0
    assert values_in(neuros.bag.open(run)) == VALUES


def test_a_packet_that_is_no_message_is_named_by_its_topic(in_sqlite: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(in_sqlite, tmp_path / "run"))
    with contextlib.closing(sqlite3.connect(run / "bag/bag.db3")) as database, database:
        database.execute("UPDATE messages SET data = x'00010000ff' WHERE id = 3")
    with pytest.raises(EnvironmentFault, match=f"bag: {NUMBER.name} cannot be read: it is damaged"):
        values_in(neuros.bag.open(run))
    with pytest.raises(EnvironmentFault, match=f"a packet of type {NUMBER.type} cannot be read"):
        [*neuros.bag.open(run)[NUMBER.name].messages()]


def test_no_packet_is_compared_with_another_because_one_before_it_is_missing(
    in_sqlite: Path, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(in_sqlite, tmp_path / "run"))
    with contextlib.closing(sqlite3.connect(run / "bag/bag.db3")) as database, database:
        database.execute("DELETE FROM messages WHERE id = 3")
    with pytest.raises(EnvironmentFault, match=f"of 200 packets of {NUMBER.name} 199 are left"):
        RecordedPackets().digests(run, str(NUMBER.connection))


def first_chunk(run: Path) -> int:
    """Where it begins: behind the magic bytes and the header."""
    data = (run / "bag/bag.mcap").read_bytes()
    at = 17 + int.from_bytes(data[9:17], "little")
    assert data[at] == 6
    return at


def changed(whole: Path, folder: Path, at: int) -> Path:
    """A copy of a run, with one other byte in its bag."""
    run = folder / "run"
    shutil.copytree(whole, run)
    file = run / "bag/bag.mcap"
    data = bytearray(file.read_bytes())
    data[at] ^= 1
    file.write_bytes(data)
    return run


def damage_header(run: Path) -> bytes:
    """Make the length of the first record of a bag greater than the file, as it is then."""
    file = run / "bag" / "bag.mcap"
    data = bytearray(file.read_bytes())
    data[9:17] = (1 << 62).to_bytes(8, "little")
    file.write_bytes(data)
    return bytes(data)
