"""Latency and digests of a connection, from the lists that its two nodes have left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neuros.api.packets import PacketLists, packet_figures, read_packets
from neuros.project.model import Connection

MS = 1_000_000


def packets(
    sent_ms: Sequence[float] = (),
    sent: Sequence[int] = (),
    received: Sequence[int] = (),
    taken: Sequence[int] = (),
    taken_ms: Sequence[float] = (),
) -> PacketLists:
    return PacketLists(
        np.array(np.array(sent_ms) * MS, np.int64),
        np.array(sent, np.uint64),
        np.array(received, np.uint64),
        np.array(taken, np.int64),
        np.array(np.array(taken_ms) * MS, np.int64),
    )


def latencies_ms(found: PacketLists, *, may_lose: bool) -> list[float] | None:
    latencies_ns = found.latencies_ns(may_lose=may_lose)
    return None if latencies_ns is None else list(latencies_ns / MS)


def test_where_nothing_is_lost_the_place_says_which_packet_it_is() -> None:
    found = packets([10, 20, 30], taken=[1, 2, 3], taken_ms=[11, 25, 37])
    assert latencies_ms(found, may_lose=False) == [1, 5, 7]


def test_the_time_of_a_pause_is_no_latency() -> None:
    found = packets([10, 20, 30, 90], taken=[1, 2, 3, 4], taken_ms=[11, 65, 66, 91])
    pauses = np.array([[22, 42], [43, 63]], np.int64) * MS
    assert latencies_ms(replace(found, pauses_ns=pauses), may_lose=False) == [1, 5, 4, 1]


def test_a_packet_that_was_skipped_has_no_latency() -> None:
    found = packets([10, 20, 30], taken=[1, 3], taken_ms=[11, 37])
    assert latencies_ms(found, may_lose=False) == [1, 7]


def test_every_hook_that_starts_on_a_packet_counts() -> None:
    found = packets([10], taken=[1, 1], taken_ms=[11, 14])
    assert latencies_ms(found, may_lose=False) == [1, 4]


def test_where_packets_are_lost_the_digest_says_which_one_it_is() -> None:
    found = packets([10, 20, 30, 40], [9, 8, 7, 6], [8, 6], taken=[1, 2], taken_ms=[21, 45])
    assert latencies_ms(found, may_lose=True) == [1, 5]


@pytest.mark.parametrize(
    ("sent", "received"),
    [
        ([9, 9, 7], [9]),  # two packets that are the same
        ([], []),  # no digests
        ([9, 8, 7], [5]),  # one that was never sent
    ],
)
def test_there_is_no_latency_where_packets_cannot_be_told_apart(
    sent: list[int], received: list[int]
) -> None:
    found = packets([10, 20, 30], sent, received, taken=[1], taken_ms=[21])
    assert latencies_ms(found, may_lose=True) is None
    assert packet_figures(found, may_lose=True)["latency_ms"] is None


def test_what_a_killed_sender_could_not_list_has_no_latency() -> None:
    found = packets([10], taken=[1, 2], taken_ms=[11, 25])
    assert latencies_ms(found, may_lose=False) == [1]


def test_figures_have_percentiles_in_milliseconds() -> None:
    count = 101
    sent_ms = np.arange(count) * 1000.0
    found = packets(sent_ms, taken=range(1, count + 1), taken_ms=sent_ms + np.arange(count))
    figures = packet_figures(found, may_lose=False)
    expected = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "max": 100.0, "count": count}
    assert figures["latency_ms"] == pytest.approx(expected)
    assert figures["digests"] is None


def test_the_digest_of_what_was_consumed_is_that_of_the_packets_that_hooks_started_on() -> None:
    found = packets([1, 2, 3], [9, 8, 7], [9, 8, 7], taken=[1, 3], taken_ms=[5, 6])
    same = packets([1, 2], [9, 7], [9, 7], taken=[1, 2, 2], taken_ms=[5, 6, 7])
    digests, expected = (packet_figures(p, may_lose=False)["digests"] for p in (found, same))
    assert digests["consumed"] == expected["sent"] == expected["consumed"]
    assert digests["sent"] != expected["sent"]
    assert (digests["sent_packets"], digests["consumed_packets"]) == (3, 2)


def test_files_are_read_as_far_as_they_were_written(tmp_path: Path) -> None:
    connection = Connection("a", "o", "b", "x", 0, index=5)
    for node, name, data in (
        ("a", "5.sent_ns", np.array([1, 2], np.int64).tobytes()),
        ("b", "5.taken", np.array([1, 2], np.int64).tobytes()),
        ("b", "5.taken_ns", np.array([4], np.int64).tobytes() + b"cut"),
    ):
        (tmp_path / node / "packets").mkdir(parents=True, exist_ok=True)
        (tmp_path / node / "packets" / name).write_bytes(data)
    found = read_packets(tmp_path, connection)
    assert list(found.latencies_ns(may_lose=False)) == [3]
    assert len(found.sent) == len(found.received) == 0


def without_the_first(found: PacketLists, sent: int, received: int, taken: int) -> PacketLists:
    """The lists of a run that has not kept so many entries of each."""
    return PacketLists(
        found.sent_ns[sent:],
        found.sent[sent:],
        found.received[received:],
        found.taken[taken:],
        found.taken_ns[taken:],
        sent_before=sent,
        received_before=received,
        taken_before=taken,
    )


@pytest.mark.parametrize("sent", [0, 1, 2])
@pytest.mark.parametrize("received", [0, 1, 2])
@pytest.mark.parametrize("taken", [0, 1, 2])
def test_latencies_are_those_of_the_packets_that_both_ends_have_kept(
    sent: int, received: int, taken: int
) -> None:
    lossless = packets([10, 20, 30], [9, 8, 7], [9, 8, 7], taken=[1, 2, 3], taken_ms=[11, 25, 37])
    found = without_the_first(lossless, sent, received, taken)
    assert latencies_ms(found, may_lose=False) == [1, 5, 7][max(sent, taken) :]
    assert found.consumed.tolist() == [9, 8, 7][max(received, taken) :]
    lossy = packets(
        [10, 15, 20, 30], [9, 5, 8, 7], [9, 8, 7], taken=[1, 2, 3], taken_ms=[11, 25, 37]
    )
    found = without_the_first(lossy, sent + (sent == 2), received, taken)
    assert latencies_ms(found, may_lose=True) == [1, 5, 7][max(sent, received, taken) :]


def test_a_digest_of_all_packets_is_none_where_the_first_are_not_kept() -> None:
    whole = packets([1, 2], [9, 8], [9, 8], taken=[1, 2], taken_ms=[5, 6])
    figures = packet_figures(without_the_first(whole, 1, 0, 0), may_lose=False)
    assert figures["digests"] is None
    assert figures["latency_ms"]["count"] == 1
