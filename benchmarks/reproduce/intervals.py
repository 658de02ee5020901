"""Intervals of ticks: their figures, and their histogram."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from benchmarks.reproduce.tables import Ours
from neuros.engine.metrics import WITHIN_MS, TickIntervals

BIN_MS = 0.1
INTERVAL_COLUMNS = (
    Ours("intervals", "intervals", "{:.0f}"),
    Ours("mean, ms", "mean_ms", "{:.3f}"),
    Ours("standard deviation, ms", "std_ms", "{:.2f}"),
    Ours("longest, ms", "max_ms"),
    *(Ours(f"within {ms} ms, %", f"within_{ms}ms_percent") for ms in WITHIN_MS),
)


def intervals_of(moments_ns: Sequence[int], period_s: float) -> dict[str, Any] | None:
    """What ``run.json`` says of a timed hook, of any moments; ``None`` of fewer than two."""
    book = TickIntervals(round(period_s * 1e9))
    for moment_ns in moments_ns:
        book.record(moment_ns)
    return book.figures()


def interval_figures(ticks: Mapping[str, Any] | None) -> dict[str, float | None]:
    """The figures of a reading."""
    if ticks is None:
        return {}
    within = {f"within_{ms}ms_percent": 100 * ticks["within"][f"{ms} ms"] for ms in WITHIN_MS}
    names = ("period_ms", "intervals", "mean_ms", "std_ms", "min_ms", "max_ms")
    return {**{name: ticks[name] for name in names}, **within}


def histogram(several: Iterable[Mapping[str, Any]]) -> tuple[list[float], list[float]]:
    """Lower ends of bins in ms, growing, and the per cent of all intervals in each."""
    counts: Counter[float] = Counter()
    for ticks in several:
        for from_ms, count in ticks["histogram"]:
            counts[round(from_ms, 1)] += count
    total = sum(counts.values())
    bins = sorted(counts)
    return bins, [100 * counts[each] / total for each in bins]
