"""The figures of WhiskEye: head direction, speed, delivery, packets, load, tick intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.reproduce import published
from benchmarks.reproduce.drawing import PUBLISHED, SERIES, bars, figure
from benchmarks.reproduce.kinds import Readings
from benchmarks.reproduce.published import NRP
from benchmarks.reproduce.tables import values_of
from benchmarks.reproduce.tick_figures import draw_ticks
from benchmarks.reproduce.whiskeye_curves import Titles, head_direction, heading_error
from benchmarks.reproduce.whiskeye_runs import CONNECTIONS

_CPU, _MEMORY = "cpu_percent.", "memory_MB."


def draw(titles: Titles, readings: Readings, folder: Path) -> dict[str, list[Path]]:
    """All figures, by the name of the table that they belong to; of repeated runs, the medians.

    What is a curve is that of the first run.
    """
    return {
        "heading": [
            head_direction(titles, readings, folder / "head_direction.png"),
            heading_error(titles, readings, folder / "heading_error.png"),
        ],
        "speed": [_speed(titles, readings, folder / "speed.png")],
        "delivery": [_delivery(titles, readings, folder / "delivery.png")],
        "packets": [_packets(titles, readings, folder / "packets.png")],
        "load": [_load(titles, readings, folder / "load.png")],
        "tick_intervals": _ticks(titles, readings, folder / "tick_intervals.png"),
    }


def _speed(titles: Titles, readings: Readings, file: Path) -> Path:
    """Left: per cent of real time; right: simulated against wall time."""
    names = [NRP, *titles]
    with figure(file, 10.0, 3.6) as drawn:
        left, right = drawn.subplots(1, 2)
        speeds = [_middle(readings, name, "speed_percent") for name in names]
        bars(left, [titles.get(name, name) for name in names], [("here", speeds)])
        _mark(left, names, published.SPEED_PERCENT)
        left.set_xscale("log")
        left.xaxis.set_major_formatter("{x:g}")
        left.set_xlabel("speed (% of real time)")
        left.legend(fontsize=8)
        for name, title in titles.items():
            points = readings[name][0].series.timeline
            if points:
                start_s = points[0][1]
                wall_s = [point[1] - start_s for point in points]
                right.plot(wall_s, [point[0] for point in points], label=title, linewidth=1.2)
        right.set_xscale("symlog", linthresh=1.0)
        right.xaxis.set_major_formatter("{x:g}")
        right.set_xlim(left=0)
        right.set_xlabel("wall time (s)")
        right.set_ylabel("simulated time (s)")
        right.grid(alpha=0.3)
        right.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return file


def _delivery(titles: Titles, readings: Readings, file: Path) -> Path:
    keys = [("all", "consumed_percent")]
    keys += [(short, f"consumed_percent.{short}") for short in CONNECTIONS.values()]
    names = list(titles)
    with figure(file, 10.0, 3.6) as drawn:
        every = drawn.subplots(1, len(keys), sharex=True, sharey=True)
        for (label, key), axes in zip(keys, every, strict=True):
            shares = [_middle(readings, name, key) for name in names]
            bars(axes, list(titles.values()), [("here", shares)])
            _mark(axes, names, published.DELIVERY_PERCENT.get(label, {}))
            axes.set_xlim(0, 105)
            axes.set_title(label, loc="left", fontsize=9)
        drawn.legend(*every[-1].get_legend_handles_labels(), loc="outside upper right", ncols=2)
        drawn.supxlabel("packets consumed, of those sent (%)", fontsize=9)
    return file


def _packets(titles: Titles, readings: Readings, file: Path) -> Path:
    names = list(titles)
    with figure(file, 10.0, 3.6) as drawn:
        every = drawn.subplots(1, len(CONNECTIONS), sharex=True, sharey=True)
        for (connection, short), axes in zip(CONNECTIONS.items(), every, strict=True):
            counts = [
                (what, [_middle(readings, name, f"{what}.{short}") for name in names])
                for what in ("sent", "consumed")
            ]
            bars(axes, list(titles.values()), counts)
            axes.set_title(connection.replace(" -> ", "\n-> "), loc="left", fontsize=9)
        drawn.legend(*every[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
        drawn.supxlabel("packets", fontsize=9)
    return file


def _load(titles: Titles, readings: Readings, file: Path) -> Path:
    """Processor time and memory of each node; diamonds: the whole machine as published."""
    names = [NRP, *titles]
    labels = [titles.get(name, name) for name in names]
    with figure(file, 10.0, 3.6) as drawn:
        left, right = drawn.subplots(1, 2, sharey=True)
        for axes, prefix in ((left, _CPU), (right, _MEMORY)):
            _stack(axes, labels, _by_node(readings, names, prefix))
        machine = [_middle(readings, name, "cpu_machine_percent") for name in names]
        places = [place for place, value in enumerate(machine) if value is not None]
        left.plot(
            [machine[place] for place in places], places, "|k", markersize=12, label="whole machine"
        )
        _mark(left, names, published.CPU_PERCENT)
        left.set_xlim(0, 105)
        left.set_xlabel("processor (% of the machine)")
        right.set_xlabel("resident memory (MB)")
        drawn.legend(*left.get_legend_handles_labels(), loc="outside upper right", ncols=5)
    return file


def _ticks(titles: Titles, readings: Readings, file: Path) -> list[Path]:
    several = {
        titles[name]: [each.series.ticks for each in readings[name] if each.series.ticks]
        for name in titles
    }
    timed = {title: ticks for title, ticks in several.items() if ticks}
    return [draw_ticks(timed, file)] if timed else []


def _by_node(readings: Readings, names: Sequence[str], prefix: str) -> dict[str, list[float]]:
    """Medians by node (or by what nodes share), one per part; 0 where there is none."""
    every = [each for several in readings.values() for each in several]
    keys = dict.fromkeys(key for each in every for key in each.figures if key.startswith(prefix))
    return {
        key.removeprefix(prefix): [_middle(readings, name, key) or 0.0 for name in names]
        for key in keys
    }


def _stack(axes: Any, labels: Sequence[str], parts: Mapping[str, Sequence[float]]) -> None:
    left = [0.0] * len(labels)
    for number, (node, values) in enumerate(parts.items()):
        colour = SERIES[number % len(SERIES)]
        axes.barh(range(len(labels)), values, 0.6, left=left, label=node, color=colour)
        left = [before + value for before, value in zip(left, values, strict=True)]
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)


def _mark(axes: Any, names: Sequence[str], known: Mapping[str, float]) -> None:
    """Put published figures into a chart of bars."""
    label = "published"
    for place, name in enumerate(names):
        if name in known:
            axes.plot(known[name], place, **PUBLISHED, linestyle="", label=label)
            label = "_published"  # once in the legend


def _middle(readings: Readings, name: str, key: str) -> float | None:
    values = values_of(readings.get(name, ()), key)
    return median(values) if values else None
