"""A bag that something has happened to: it reads as it was written, or says that it does not."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from recordings import NUMBER, number, plan, spool

import neuros.bag
from neuros.api.verify import RecordedPackets
from neuros.bag import Bag
from neuros.cli.main import main
from neuros.errors import EnvironmentFault

VALUES = [*range(1, 201)]
CHECKSUM = 33  # of a chunk, from its beginning


def recorded(run: Path, values: Sequence[int] = VALUES) -> Path:
    """The folder of a run with a bag."""
    plan().save(run)
    spool(run, "a", [(at, None, number(value)) for at, value in enumerate(values, 1)])
    neuros.bag.open(run).close()
    return run


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("run"))


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
    run = changed(whole, tmp_path, chunks(whole)[0] + CHECKSUM)
    with pytest.raises(EnvironmentFault, match=r"bag\.mcap is damaged between bytes \d+ and \d+"):
        values_in(neuros.bag.open(run))
    with pytest.raises(EnvironmentFault, match="is damaged between bytes"):
        RecordedPackets().digests(run, str(NUMBER.connection))
    assert main(["bag", "info", str(run)]) == 4
    assert "is damaged between bytes" in capsys.readouterr().err
    kept = tmp_path / "kept"
    shutil.copytree(run, kept)
    assert main(["bag", "repair", str(run)]) == 4
    said = capsys.readouterr().err
    assert "is damaged between bytes" in said
    assert f"{2 * len(VALUES)} packets, any of which may have changed, are left out" in said
    assert f"the damaged bag is kept in {run}/bag.before_repair" in said
    assert values_in(neuros.bag.open(run)) == []
    assert (run / "bag.before_repair/bag.mcap").exists()

    assert main(["bag", "repair", str(kept), "--keep-changed"]) == 4
    assert "any of which may have changed, are kept" in capsys.readouterr().err
    assert values_in(neuros.bag.open(kept)) == VALUES


def test_only_packets_of_the_part_that_has_changed_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    values = [*range(1, 100_001)]
    recorded(run, values)
    places = chunks(run)
    change(run, places[1] + 1000)  # among its packets
    assert main(["bag", "repair", str(run)]) == 4
    assert f"is damaged between bytes {places[1]} and " in capsys.readouterr().err
    left = values_in(neuros.bag.open(run))
    assert set(left) < {*values}
    assert len(left) > 50_000
    assert left == sorted(left)


@pytest.mark.parametrize(
    ("of_chunk", "at"),
    [
        pytest.param(False, 0, id="magic"),
        pytest.param(False, 14, id="length of the header"),
        pytest.param(True, 0, id="kind of a chunk"),
        pytest.param(True, 7, id="length of a chunk"),
    ],
)
def test_a_byte_between_packets_costs_none(
    whole: Path, tmp_path: Path, of_chunk: bool, at: int
) -> None:
    run = changed(whole, tmp_path, at + of_chunk * chunks(whole)[0])
    assert main(["bag", "repair", str(run)]) == 0
    assert values_in(neuros.bag.open(run)) == VALUES


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
    whole: Path, tmp_path: Path, new: bytes
) -> None:
    run = Path(shutil.copytree(whole, tmp_path / "run"))
    file = run / "bag/bag.mcap"
    before, found, after = file.read_bytes().rpartition(b"int32 data")  # in the summary
    assert found
    file.write_bytes(before + new + after)
    assert main(["bag", "repair", str(run)]) == 0
    assert values_in(neuros.bag.open(run)) == VALUES


def test_a_packet_that_is_no_message_is_named_by_its_topic(tmp_path: Path) -> None:
    plan().save(tmp_path)
    spool(tmp_path, "a", [(1, None, number(1)), (2, None, b"\0\1\0\0\xff")])
    with pytest.raises(EnvironmentFault, match=f"bag: {NUMBER.name} cannot be read: it is damaged"):
        values_in(neuros.bag.open(tmp_path))
    with pytest.raises(EnvironmentFault, match=f"a packet of type {NUMBER.type} cannot be read"):
        [*neuros.bag.open(tmp_path)[NUMBER.name].messages()]


def chunks(run: Path) -> list[int]:
    """Where they begin."""
    with (run / "bag/bag.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [index.chunk_start_offset for index in summary.chunk_indexes]


def change(run: Path, at: int) -> None:
    """Another byte in the bag of a run."""
    file = run / "bag/bag.mcap"
    data = bytearray(file.read_bytes())
    data[at] ^= 1
    file.write_bytes(data)


def changed(whole: Path, folder: Path, at: int) -> Path:
    """A copy of a run, with one other byte in its bag."""
    run = Path(shutil.copytree(whole, folder / "run"))
    change(run, at)
    return run
