"""Shared memory gives back what was stored, or says that it has been overwritten: never a mix."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.transport.large_packets import Overwritten, SegmentReader, SegmentWriter

TYPES = "B", "d"


def _packet(number: int, size: int) -> list[array[Any]]:
    """Two buffers that tell which packet they belong to."""
    return [array("B", bytes([number % 256]) * size), array("d", [float(number)] * (size % 7))]


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[SegmentWriter]:
    writer = SegmentWriter("run_node_output", 2, tmp_path)
    yield writer
    writer.close()


@settings(max_examples=60, deadline=None)
@given(
    slots=st.integers(1, 4),
    sizes=st.lists(st.integers(0, 9000), min_size=1, max_size=15),
    readers=st.integers(1, 3),
    data=st.data(),
)
def test_a_packet_is_read_as_it_was_written_until_as_many_as_slots_have_followed(
    tmp_path_factory: pytest.TempPathFactory,
    slots: int,
    sizes: list[int],
    readers: int,
    data: st.DataObject,
) -> None:
    folder = tmp_path_factory.mktemp("shm")
    writer = SegmentWriter("owner", slots, folder)
    ends = [SegmentReader(folder) for _ in range(readers)]
    places = []
    for number, size in enumerate(sizes):
        places.append(writer.write(_packet(number, size)))
        for reader in ends:
            asked = data.draw(st.integers(0, number))
            is_kept = asked > number - slots
            try:
                found = reader.read(places[asked], TYPES)
            except Overwritten:
                assert not is_kept
            else:
                if found is None:  # its segment had been replaced by a larger one, and removed
                    assert not is_kept
                else:
                    assert found == _packet(asked, sizes[asked])
    writer.close()
    assert not list(folder.iterdir())


def test_a_packet_that_is_read_too_late_is_overwritten(
    tmp_path: Path, writer: SegmentWriter
) -> None:
    reader = SegmentReader(tmp_path)
    late = writer.write(_packet(1, 100))
    writer.write(_packet(2, 100))
    writer.write(_packet(3, 100))
    with pytest.raises(Overwritten):
        reader.read(late, TYPES)


def test_what_is_mapped_stays_readable_after_the_sender_has_ended(
    tmp_path: Path, writer: SegmentWriter
) -> None:
    reader = SegmentReader(tmp_path)
    reader.read(writer.write(_packet(1, 100)), TYPES)
    place = writer.write(_packet(2, 100))
    writer.close()
    assert reader.read(place, TYPES) == _packet(2, 100)


def test_a_segment_that_is_gone_has_nothing(tmp_path: Path, writer: SegmentWriter) -> None:
    place = writer.write(_packet(1, 100))
    writer.close()
    assert SegmentReader(tmp_path).read(place, TYPES) is None


def test_a_larger_packet_gets_a_larger_segment_and_the_former_goes_when_it_is_of_no_use(
    tmp_path: Path, writer: SegmentWriter
) -> None:
    first = writer.write(_packet(1, 5000))
    assert writer.write(_packet(2, 50)).segment == first.segment
    second = writer.write(_packet(3, 50_000))
    assert {path.name for path in tmp_path.iterdir()} == {first.segment, second.segment}
    for number in range(4, 7):
        writer.write(_packet(number, 50_000))
    assert {path.name for path in tmp_path.iterdir()} == {second.segment}


def test_only_the_user_may_open_it_and_the_name_says_whose_it_is(
    tmp_path: Path, writer: SegmentWriter
) -> None:
    place = writer.write(_packet(1, 100))
    assert (tmp_path / place.segment).stat().st_mode & 0o777 == 0o600
    assert place.segment.startswith("neuros_run_node_output_")


def test_without_room_nothing_is_left_behind(
    tmp_path: Path, writer: SegmentWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with pytest.raises(OSError, match="No space left"):
        writer.write(_packet(1, 100))
    assert not list(tmp_path.iterdir())


def test_a_place_beyond_the_end_is_refused(tmp_path: Path, writer: SegmentWriter) -> None:
    place = writer.write(_packet(1, 100))
    with pytest.raises(ValueError, match="beyond"):
        SegmentReader(tmp_path).read(dataclasses.replace(place, lengths=(100, 1 << 20)), TYPES)


def test_a_link_to_a_file_of_another_kind_is_not_followed(
    tmp_path: Path, writer: SegmentWriter
) -> None:
    place = writer.write(_packet(1, 100))
    (tmp_path / place.segment).rename(tmp_path / "elsewhere")
    (tmp_path / place.segment).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match=place.segment):
        SegmentReader(tmp_path).read(place, TYPES)


def _write_without_pause(folder: Path, pipe: Any) -> None:
    writer = SegmentWriter("owner", 2, folder)
    number = 0
    while not pipe.poll():
        number += 1
        pipe.send(writer.write([array("B", bytes([number % 256]) * 300_000)]))
    pipe.close()


def test_a_reader_that_is_overtaken_while_it_copies_never_gets_a_mix(tmp_path: Path) -> None:
    processes = multiprocessing.get_context("fork")
    here, there = processes.Pipe()
    child = processes.Process(target=_write_without_pause, args=(tmp_path, there))
    child.start()
    there.close()
    reader = SegmentReader(tmp_path)
    read = overtaken = 0
    try:
        while read < 300 and read + overtaken < 100_000:
            place = here.recv()
            try:
                found = reader.read(place, "B")
            except Overwritten:
                overtaken += 1
            else:
                read += 1
                assert found == [array("B", bytes([place.generation % 256]) * 300_000)]
    finally:
        here.close()
        child.terminate()
        child.join(10)
    assert read
