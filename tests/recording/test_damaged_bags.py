"""A bag that something has happened to: it reads as it was written, or says that it does not."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recording.recordings import NUMBER, number, plan, spool

import neuros.bag
from neuros.bag import Bag
from neuros.cli.main import main
from neuros.errors import EnvironmentFault

VALUES = [*range(1, 201)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with a bag."""
    run = tmp_path_factory.mktemp("run")
    plan().save(run)
    spool(run, "a", [(value, None, number(value)) for value in VALUES])
    neuros.bag.open(run).close()
    return run


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
    chunk = 17 + int.from_bytes(data[9:17], "little")  # behind the magic bytes and the header
    assert data[chunk] == 6
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


def damage_header(run: Path) -> bytes:
    """Make the length of the first record of a bag greater than the file, as it is then."""
    file = run / "bag" / "bag.mcap"
    data = bytearray(file.read_bytes())
    data[9:17] = (1 << 62).to_bytes(8, "little")
    file.write_bytes(data)
    return bytes(data)
