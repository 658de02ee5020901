"""Histograms of tick intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.reproduce.drawing import OURS, figure, panels
from benchmarks.reproduce.intervals import BIN_MS, histogram
from benchmarks.reproduce.tables import spread_text

Ticks = Mapping[str, Any]

_BEYOND_MS = 5.0
"""What is shown to both sides of the period; intervals further away are in the outermost bars."""
_COLUMNS = 3


def draw_ticks(parts: Mapping[str, Sequence[Ticks]], file: Path) -> Path:
    """How often an interval was off its period by how much: a panel per part, of all its runs."""
    columns = min(_COLUMNS, len(parts))
    rows = -(-len(parts) // columns)
    with figure(file, 10.0, 0.4 + 2.8 * rows) as drawn:
        every = panels(drawn, len(parts), columns)
        for (title, several), axes in zip(parts.items(), every, strict=True):
            period_ms = several[0]["period_ms"]
            bins, percents = histogram(several)
            shown: dict[float, float] = {}
            for from_ms, percent in zip(bins, percents, strict=True):
                off_ms = min(max(from_ms - period_ms, -_BEYOND_MS), _BEYOND_MS)
                place = round(off_ms, 1)
                shown[place] = shown.get(place, 0.0) + percent
            axes.bar(list(shown), list(shown.values()), BIN_MS, align="edge", color=OURS)
            deviation = spread_text([ticks["std_ms"] for ticks in several], "{:.2f}")
            axes.set_title(f"{title}\nstandard deviation {deviation} ms", loc="left", fontsize=8)
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_xlim(-_BEYOND_MS - 2 * BIN_MS, _BEYOND_MS + 2 * BIN_MS)
            axes.set_xlabel(f"interval - {period_ms:g} ms (ms)")
        drawn.supylabel("share of the intervals (%)", fontsize=9)
    return file
