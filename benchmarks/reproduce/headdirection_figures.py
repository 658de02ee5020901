"""The figures of the corrected ring: errors over time, and their size beside the published ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.reproduce import published
from benchmarks.reproduce.drawing import PUBLISHED, SERIES, TRUTH, bars, figure, panels
from benchmarks.reproduce.kinds import Readings
from benchmarks.reproduce.tables import values_of

Errors = Mapping[str, tuple[Any, Any]]
"""By what told the heading: times in s and errors in degrees, ``(n,)`` each."""

_BESIDE = {"textcoords": "offset points", "fontsize": 8}


def draw(
    titles: Mapping[str, str], readings: Readings, series: Mapping[str, str], folder: Path
) -> list[Path]:
    """Both figures; of repeated runs, the errors over time of the first, else medians."""
    return [
        _over_time(titles, readings, folder / "correction_error.png"),
        _sizes(titles, readings, series, folder / "correction_rms.png"),
    ]


def _over_time(titles: Mapping[str, str], readings: Readings, file: Path) -> Path:
    with figure(file, 10.0, 0.6 + 1.9 * -(-len(titles) // 2)) as drawn:
        drawn.supxlabel("simulated time (s)", fontsize=9)
        drawn.supylabel("error of the heading (deg)", fontsize=9)
        for (name, title), axes in zip(titles.items(), panels(drawn, len(titles), 2), strict=True):
            errors: Errors = readings[name][0].series
            axes.axhline(0, color=TRUTH, linewidth=1)
            for (label, (time_s, error_deg)), colour in zip(errors.items(), SERIES, strict=True):
                axes.plot(time_s, error_deg, ".", color=colour, markersize=2, label=label)
            axes.set_yscale("symlog", linthresh=10)
            axes.set_title(title, loc="left", fontsize=9)
        handles = axes.get_legend_handles_labels()
        drawn.legend(*handles, loc="outside upper right", ncols=3, markerscale=4)
    return file


def _sizes(
    titles: Mapping[str, str], readings: Readings, series: Mapping[str, str], file: Path
) -> Path:
    """RMS errors; diamonds: published."""
    names = [*titles, *published.HEAD_DIRECTION]
    with figure(file, 10.0, 1.2 + 0.4 * len(names)) as drawn:
        axes = drawn.subplots()
        sizes = []
        for key, label in series.items():
            found = [values_of(readings.get(name, ()), f"{key}_rms_deg") for name in names]
            sizes.append((label, [median(values) if values else None for values in found]))
        bars(axes, [titles.get(name, name) for name in names], sizes)
        for place, name in enumerate(names):
            for (label, _), key in zip(sizes, series, strict=True):
                rms_deg = published.HEAD_DIRECTION.get(name, {}).get(f"{key}_rms_deg")
                if rms_deg is not None:
                    axes.plot(rms_deg, place, **PUBLISHED, linestyle="")
                    axes.annotate(label, (rms_deg, place), (8, 0), va="center", **_BESIDE)
        axes.set_xscale("log")
        axes.set_xlim(left=0.5)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_xlabel("RMS error of the heading (deg)")
        drawn.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return file
