"""Figures of sums and distributions: time, packets, latencies, ticks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from neuros.observe.review.run import Run
from neuros.observe.review.style import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    STATES,
    YELLOW,
    colour,
    new_figure,
    plain,
)

_FATES = {"consumed": BLUE, "unread": YELLOW, "discarded": ORANGE, "lost": RED}
_POINTS = 500
_MOST_TICKS = 12


def spending_figure(run: Run) -> Any | None:
    """How each node divided its time; ``None`` if none has reported."""
    spending = run.spending
    if not spending:
        return None
    names = list(spending)[::-1]
    figure = new_figure(0.42 * len(names) + 1.2)
    axes = plain(figure.add_subplot())
    lefts = np.zeros(len(names))
    for state, shade in STATES.items():
        shares = np.array([100 * spending[name].shares[state] for name in names])
        axes.barh(names, shares, left=lefts, color=shade, label=state, height=0.65)
        for row, share in enumerate(shares):
            if share >= 6:
                where = lefts[row] + share / 2
                axes.text(where, row, f"{share:.0f}", ha="center", va="center", fontsize=8)
        lefts += shares
    axes.set(xlabel="share of the time in which all nodes ran / %", xlim=(0, 100))
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def counts_figure(run: Run) -> Any | None:
    """What became of the packets of every connection."""
    names = list(run.connections)[::-1]
    if not names:
        return None
    figure = new_figure(0.42 * len(names) + 1.2)
    axes = plain(figure.add_subplot())
    lefts = np.zeros(len(names))
    for fate, shade in _FATES.items():
        counts = np.array([run.connections[name].get(fate) or 0 for name in names], float)
        axes.barh(names, counts, left=lefts, color=shade, label=fate, height=0.65)
        lefts += counts
    for row, name in enumerate(names):
        sent = run.connections[name].get("sent")
        axes.text(lefts[row], row, f" {'?' if sent is None else f'{sent:,}'} sent", va="center",
                  fontsize=8)  # fmt: skip
    axes.set_xlim(0, max(float(lefts.max()), 1.0) * 1.18)
    axes.set_xlabel("packets")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def latency_figure(run: Run) -> Any | None:
    """The share of packets on which a hook had started after a time; ``None`` without lists."""
    curves = {}
    for name, packets in run.packets.items():
        figures = run.connections[name]
        has_lost = figures.get("discard_limit") is None and (
            figures.get("sent") != figures.get("received")
        )
        latencies_ns = packets.latencies_ns(may_lose=has_lost)
        if latencies_ns is not None and len(latencies_ns):
            shares = np.linspace(0, 100, min(_POINTS, len(latencies_ns) + 1))
            curves[name] = np.percentile(latencies_ns, shares) / 1e6, shares
    if not curves:
        return None
    rows = -(-len(curves) // 2)
    figure = new_figure(3.2 + 0.2 * rows)
    axes = plain(figure.add_subplot())
    for place, (name, (ms, shares)) in enumerate(curves.items()):
        style = ("-", "--", ":")[place // 8 % 3]
        axes.plot(np.maximum(ms, 1e-3), shares, style, color=colour(place), label=name)
    axes.set_xscale("log")
    axes.set(xlabel="from sending to the start of a hook / ms", ylabel="packets / %", ylim=(0, 100))
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    return figure


def ticks_figure(run: Run) -> Any | None:
    """Histograms of the intervals of timed hooks; ``None`` if there are none."""
    ticks = [
        (f"{node}.{hook}", figures["ticks"])
        for node, books in run.nodes.items()
        for hook, figures in (books.get("hooks") or {}).items()
        if figures.get("ticks")
    ][:_MOST_TICKS]
    if not ticks:
        return None
    figure = new_figure(2.6 * len(ticks))
    for axes, (name, each) in zip(figure.subplots(len(ticks), squeeze=False)[:, 0], ticks,
                                  strict=True):  # fmt: skip
        _draw_ticks(plain(axes), name, each)
    return figure


def _draw_ticks(axes: Any, name: str, ticks: Mapping[str, Any]) -> None:
    from matplotlib.ticker import MaxNLocator

    from_ms, counts = zip(*ticks["histogram"], strict=True)
    low, high = min(from_ms), max(from_ms) + 0.1
    bins = max(1, round((high - low) / 0.1))
    width = 0.1 * max(1, -(-bins // 80))
    edges = np.arange(low, high + width, width)
    axes.hist(np.array(from_ms) + 0.05, bins=edges, weights=counts, color=BLUE)
    axes.axvline(ticks["period_ms"], color=GREY, linestyle="--", linewidth=1)
    within = ", ".join(f"{share:.1%} within {ms}" for ms, share in ticks["within"].items())
    axes.set_title(
        f"{name}: period {ticks['period_ms']:g} ms (dashed), standard deviation"
        f" {ticks['std_ms']:.2f} ms\n{within}",
        fontsize=9, loc="left",
    )  # fmt: skip
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="interval between starts / ms", ylabel="intervals")
