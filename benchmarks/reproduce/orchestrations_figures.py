"""Accuracy against loss, latency and speed, and against the computing time of the network."""

from __future__ import annotations

from pathlib import Path
from statistics import median

from benchmarks.reproduce.drawing import figure
from benchmarks.reproduce.kinds import Readings
from benchmarks.reproduce.orchestrations import COMPUTING_MS, MACHINES, ORCHESTRATIONS
from benchmarks.reproduce.tables import values_of

ERRORS = {"rms_deg": "RMS at the stamp (deg)", "known_rms_deg": "RMS at the moment (deg)"}
COSTS = {
    "loss_percent": "packets of the IMU lost (%)",
    "latency_ms": "latency (ms)",
    "speed_percent": "speed (% of real time)",
}
COLOURS = ("#3465a4", "#4e9fd1", "#9cc9e3", "#1b7f4d", "#c0392b", "#8e44ad", "#e08b27")
MARKERS = dict(zip(MACHINES, ("o", "D"), strict=True))


def draw_costs(readings: Readings, file: Path) -> Path:
    """A panel per cost and kind of error; bands reach from the least to the largest seed."""
    with figure(file, 10.0, 6.2) as drawn:
        every = drawn.subplots(len(ERRORS), len(COSTS), sharex="col", sharey="row")
        for (error, y_label), row in zip(ERRORS.items(), every, strict=True):
            for (cost, x_label), axes in zip(COSTS.items(), row, strict=True):
                for (name, title), colour in zip(ORCHESTRATIONS.items(), COLOURS, strict=True):
                    for machine, marker in MARKERS.items():
                        several = readings.get(f"{name}.{machine}", ())
                        xs, ys = values_of(several, cost), values_of(several, error)
                        if not (xs and ys):
                            continue
                        x, y = median(xs), median(ys)
                        axes.errorbar(
                            [x],
                            [y],
                            xerr=[[x - min(xs)], [max(xs) - x]],
                            yerr=[[y - min(ys)], [max(ys) - y]],
                            color=colour,
                            marker=marker,
                            markerfacecolor="white" if machine != "here" else colour,
                            label=f"{title}, {MACHINES[machine]}",
                        )
                axes.set_yscale("log")
                axes.yaxis.set_major_formatter("{x:g}")
                axes.grid(alpha=0.3)
                if error == [*ERRORS][-1]:
                    axes.set_xlabel(x_label)
            row[0].set_ylabel(y_label)
        for axes in every[:, 1:].flat:
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")
        drawn.legend(
            *every[0][0].get_legend_handles_labels(),
            loc="outside lower center",
            ncols=4,
            fontsize=8,
        )
    return file


def draw_computing(readings: Readings, file: Path) -> Path:
    """A line per orchestration; bands reach from the least to the largest seed."""
    with figure(file, 10.0, 4.4) as drawn:
        every = drawn.subplots(1, len(ERRORS), sharex=True, sharey=True)
        for (error, y_label), axes in zip(ERRORS.items(), every, strict=True):
            for (name, title), colour in zip(ORCHESTRATIONS.items(), COLOURS, strict=True):
                found = {
                    ms: values
                    for ms in COMPUTING_MS
                    if (values := values_of(readings.get(f"{name}.{ms}ms", ()), error))
                }
                if not found:
                    continue
                middle = [median(values) for values in found.values()]
                axes.plot([*found], middle, "o-", color=colour, markersize=3, label=title)
                low, high = ([f(values) for values in found.values()] for f in (min, max))
                axes.fill_between([*found], low, high, color=colour, alpha=0.2, linewidth=0)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xticks(COMPUTING_MS, [f"{ms:g}" for ms in COMPUTING_MS])
            axes.minorticks_off()
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_xlabel("computing time of the network per packet (ms)")
            axes.set_ylabel(y_label)
            axes.grid(alpha=0.3)
        drawn.legend(
            *every[0].get_legend_handles_labels(), loc="outside lower center", ncols=7, fontsize=8
        )
    return file
