"""What a node keeps for the recording is read back whole and in order, however it was cut."""

from __future__ import annotations

import os
import struct
import time
from itertools import count
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.ports import Way
from neuros.recording.recording_plan import RecordedStream
from neuros.recording.spool import NO_TIME, SpoolReader, SpoolRecord, SpoolWriter

STREAMS = (RecordedStream("sent", "imu", (0,)), RecordedStream("heard", "camera", (1,)))
IMU, CAMERA = range(2)


def writer(folder: Path, file_bytes: int = 1 << 20) -> SpoolWriter:
    ticks = count(1)
    return SpoolWriter(folder, STREAMS, file_bytes=file_bytes, clock=lambda: next(ticks) * 10)


def read_all(reader: SpoolReader, most_bytes: int = 1 << 20) -> list[SpoolRecord]:
    records, has_more = reader.read(most_bytes)
    while has_more:
        more, has_more = reader.read(most_bytes)
        records += more
    return records


def files(folder: Path) -> list[str]:
    return sorted(os.listdir(folder / "spool"))


def test_a_packet_is_read_with_its_stream_and_times(tmp_path: Path) -> None:
    spool = writer(tmp_path)
    spool.keep(IMU, b"one", None, None)
    spool.keep(CAMERA, b"two", 1.5, None)
    assert read_all(SpoolReader(tmp_path)) == [
        SpoolRecord(10, NO_TIME, 0, b"one"),
        SpoolRecord(20, 1_500_000_000, 1, b"two"),
    ]


def test_only_planned_packets_are_wanted(tmp_path: Path) -> None:
    spool = writer(tmp_path)
    assert spool.stream(Way.SENT, "imu") == IMU
    assert spool.stream(Way.HEARD, "camera") == CAMERA
    assert spool.stream(Way.HEARD, "imu") is None
    assert spool.stream(Way.SENT, "camera") is None


def test_times_of_a_spool_differ_even_where_the_clock_stands_still(tmp_path: Path) -> None:
    spool = SpoolWriter(tmp_path, STREAMS, clock=lambda: 7)
    for _ in range(3):
        spool.keep(IMU, b"x", None, None)
    assert [r.wall_ns for r in read_all(SpoolReader(tmp_path))] == [7, 8, 9]


def test_times_go_on_where_somebody_sets_the_clock_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walls_s, monotonics_s = [1000, 1001, 402, 403], [50, 51, 52, 53]
    monkeypatch.setattr(time, "time_ns", lambda: walls_s.pop(0) * 10**9)
    monkeypatch.setattr(time, "monotonic_ns", lambda: monotonics_s.pop(0) * 10**9)
    spool = SpoolWriter(tmp_path, STREAMS)
    for _ in range(3):
        spool.keep(IMU, b"a", None, None)
    assert [r.wall_ns // 10**9 for r in read_all(SpoolReader(tmp_path))] == [1001, 1002, 1003]


@settings(deadline=None)
@given(
    packets=st.lists(st.binary(max_size=300), max_size=40),
    file_bytes=st.integers(1, 500),
    most_bytes=st.integers(1, 400),
    reads=st.lists(st.booleans(), min_size=40, max_size=40),
)
def test_all_is_read_once_whatever_the_sizes_and_whenever_one_reads(
    tmp_path_factory: pytest.TempPathFactory,
    packets: list[bytes],
    file_bytes: int,
    most_bytes: int,
    reads: list[bool],
) -> None:
    folder = tmp_path_factory.mktemp("node")
    spool, reader = writer(folder, file_bytes), SpoolReader(folder)
    found: list[SpoolRecord] = []
    for packet, is_read in zip(packets, reads, strict=False):
        spool.keep(IMU, packet, None, None)
        if is_read:
            found += reader.read(most_bytes)[0]
            reader.remove_up_to(found[-1].wall_ns if found else 0)
    found += read_all(reader, most_bytes)
    assert [record.data for record in found] == packets
    spool.close()
    reader.close(remove=True)
    assert not (folder / "spool").exists() or not packets


def test_a_record_that_was_cut_off_is_left_out(tmp_path: Path) -> None:
    spool = writer(tmp_path)
    spool.keep(IMU, b"whole", None, None)
    spool.keep(IMU, b"cut off", None, None)
    (name,) = files(tmp_path)
    path = tmp_path / "spool" / name
    path.write_bytes(path.read_bytes()[:-1])
    assert [r.data for r in read_all(SpoolReader(tmp_path))] == [b"whole"]


def test_a_record_that_claims_more_than_a_packet_may_have_costs_neither_time_nor_memory(
    tmp_path: Path,
) -> None:
    spool = writer(tmp_path)
    spool.keep(IMU, b"first", None, None)
    spool.close()
    (file,) = (tmp_path / "spool").iterdir()
    with file.open("ab") as more:
        more.write(struct.pack("<IIqq", 0xFFFFFFFF, 0, 0, NO_TIME))
    os.truncate(file, 4 << 30)  # without a block on the disk
    reader = SpoolReader(tmp_path)
    assert [record.data for record in read_all(reader)] == [b"first"]
    assert reader.is_damaged
    assert reader.read(1 << 20) == ([], False)
    reader.close(remove=False)


def test_a_record_is_read_once_all_of_it_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However little is asked for at a time; else a large one took quadratic time."""
    spool, large = writer(tmp_path), bytes(range(256)) * 4096
    spool.keep(IMU, large, None, None)
    (file,) = (tmp_path / "spool").iterdir()
    content = file.read_bytes()
    read, sizes = os.read, []
    monkeypatch.setattr(os, "read", lambda *a: sizes.append(len(d := read(*a))) or d)
    reader = SpoolReader(tmp_path)
    os.truncate(file, len(content) // 2)
    assert read_all(reader, 4096) == read_all(reader, 4096) == []
    with file.open("r+b") as whole:
        whole.write(content)
    assert [record.data for record in read_all(reader, 4096)] == [large]
    assert len(sizes) == 2
    spool.keep(CAMERA, b"next", None, None)
    assert [record.data for record in read_all(reader, 4096)] == [b"next"]
    spool.close()
    reader.close(remove=False)


def test_a_cut_off_record_in_a_file_that_was_left_is_passed_over(tmp_path: Path) -> None:
    spool = writer(tmp_path, file_bytes=1)
    for data in (b"cut" * 50, b"whole"):
        spool.keep(IMU, data, None, None)
    spool.close()
    os.truncate(tmp_path / "spool" / files(tmp_path)[0], 60)
    reader = SpoolReader(tmp_path)
    assert [record.data for record in read_all(reader)] == [b"whole"]
    reader.close(remove=False)


def test_a_packet_that_is_too_large_is_refused_by_its_writer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuros.recording.spool.MOST_BYTES", 100)
    spool = writer(tmp_path)
    with pytest.raises(OSError, match="a packet of 101 bytes; 100 are the most"):
        spool.keep(IMU, bytes(101), None, None)
    spool.keep(IMU, bytes(100), None, None)
    spool.close()


def test_a_file_goes_only_once_its_last_packet_is_safe(tmp_path: Path) -> None:
    spool, reader = writer(tmp_path, file_bytes=1), SpoolReader(tmp_path)
    for packet in (b"a", b"b", b"c"):
        spool.keep(IMU, packet, None, None)
    assert len(read_all(reader)) == 3
    reader.remove_up_to(10)
    assert files(tmp_path) == ["00000001", "00000002"]
    reader.remove_up_to(20)
    assert files(tmp_path) == ["00000002"]


def test_a_reader_sees_whether_somebody_may_still_write(tmp_path: Path) -> None:
    spool, reader = writer(tmp_path), SpoolReader(tmp_path)
    spool.keep(IMU, b"a", None, None)
    read_all(reader)
    assert reader.is_fed
    spool.close()
    assert not reader.is_fed


def test_a_folder_that_cannot_be_written_is_an_os_error(tmp_path: Path) -> None:
    (tmp_path / "spool").write_text("in the way")
    with pytest.raises(FileExistsError, match="spool"):
        writer(tmp_path).keep(IMU, b"a", None, None)


def test_a_full_disk_is_an_os_error(tmp_path: Path) -> None:
    spool = writer(tmp_path)
    (tmp_path / "spool").mkdir()
    spool._descriptor = os.open("/dev/full", os.O_WRONLY)
    with pytest.raises(OSError, match="No space left"):
        spool.keep(IMU, b"a", None, None)
    spool.close()
