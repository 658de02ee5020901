"""What is said of ticks and of arriving packets follows from their moments alone."""

from __future__ import annotations

import pytest

from benchmarks.plugins.arrivals import Arrivals, flood
from benchmarks.subjects.tick import regularity

MS = 1_000_000


def test_ticks_on_schedule_are_all_in_time() -> None:
    moments_ns = [7 + number * 20 * MS for number in range(50)]
    assert regularity(moments_ns, 0.02) == {"share": 1.0, "deviation": 0.0}


def test_what_all_ticks_are_late_by_does_not_count() -> None:
    late_at_first = [5 * MS] + [number * 20 * MS for number in range(1, 50)]
    assert regularity(late_at_first, 0.02)["share"] == pytest.approx(49 / 50)


def test_a_tick_that_did_not_come_was_not_in_time() -> None:
    moments_ns = [number * 20 * MS for number in range(50) if number not in (10, 11)]
    assert regularity(moments_ns, 0.02)["share"] == pytest.approx(48 / 50)


def test_the_deviation_is_that_from_the_schedule_in_microseconds() -> None:
    moments_ns = [number * 20 * MS + (100_000 if number % 2 else -100_000) for number in range(50)]
    assert regularity(moments_ns, 0.02)["deviation"] == pytest.approx(100)


def test_arrivals_count_after_the_warm_up_and_know_what_was_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = [100.0]
    monkeypatch.setattr("benchmarks.plugins.arrivals.time.monotonic", lambda: now_s[0])
    arrivals = Arrivals(seconds=1.0)
    number = 0
    is_done = False
    while not is_done:
        number += 2  # every other packet is lost
        is_done = arrivals.take(flood("source", number))
        now_s[0] += 0.01
    result = arrivals.result()
    assert result["rate"] == pytest.approx(100)
    assert result["delivered"] == pytest.approx(0.5, abs=0.01)
    assert "latency" not in result


def test_paced_packets_tell_how_long_they_were_under_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.plugins.arrivals.time.monotonic", lambda: 1.5)
    arrivals = Arrivals(seconds=1.0)
    for sent_ns in (1_499_000_000, 1_498_000_000, 1_200_000_000):
        assert not arrivals.take(f"paced {sent_ns}")
    assert arrivals.result()["latency"] == pytest.approx(2000)
