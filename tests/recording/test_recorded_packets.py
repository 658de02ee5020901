"""Packets and digests from the bags of runs."""

from __future__ import annotations

from pathlib import Path

from recordings import NUMBER, number, plan, record, spool
from xxhash import xxh3_64_intdigest

from neuros.api.verify import _LARGE_BYTES, RecordedPackets
from neuros.transport.large_packets import LARGE_BYTES


def test_digests_are_those_of_the_packets_in_the_order_in_which_they_were_sent(
    tmp_path: Path,
) -> None:
    spool(tmp_path, "a", [(10, None, number(1)), (30, None, number(3)), (30, None, number(2))])
    record(tmp_path, plan())
    found, name = RecordedPackets(), NUMBER.connection or ""
    digests = found.digests(tmp_path, name)
    assert digests is not None
    assert digests.tolist() == [xxh3_64_intdigest(number(n)) for n in (1, 3, 2)]
    assert found.are_as_of_nodes(tmp_path, name)
    assert found.message(tmp_path, name, 2).data == 3
    assert found.message(tmp_path, name, 4) is None
    assert found.digests(tmp_path, "a.out -> b.in") is None


def test_a_run_without_a_recording_has_nothing_and_a_damaged_one_says_so(tmp_path: Path) -> None:
    found = RecordedPackets()
    assert found.digests(tmp_path, NUMBER.connection or "") is None
    assert found.remarks == []
    (tmp_path / "recording.json").write_text("{")
    found = RecordedPackets()
    assert found.message(tmp_path, NUMBER.connection or "", 1) is None
    assert "recording.json is damaged" in found.remarks[0]


def test_packets_are_large_from_the_size_on_from_which_nodes_digest_them_apart() -> None:
    assert _LARGE_BYTES == LARGE_BYTES
