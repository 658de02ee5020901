"""All figures of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from neuros.observe.review import bars, graph, lanes, series
from neuros.observe.review.page import png
from neuros.observe.review.run import Run

_FIGURES: tuple[tuple[str, str, str, Callable[[Run], Any]], ...] = (
    (
        "graph",
        "Nodes and connections",
        "Each node with its busiest hook and how it spent its time; each connection with its"
        " guarantee, what it carried and lost, and how long a packet waited for a hook (median).",
        graph.graph_figure,
    ),
    (
        "time_shares",
        "Where the time went",
        "Shares of each node's time, without the start and the end of the run; what is missing to"
        " 100 % is scheduling: a hook whose turn has not come.",
        bars.spending_figure,
    ),
    (
        "swim_lanes",
        "Who waits for whom",
        "Hooks as bars, packets from their sender to the start of a hook on them, and"
        " acknowledgements back.",
        lanes.lanes_figure,
    ),
    (
        "real_time",
        "Simulated against real time",
        "One point per simulated second; wall time from the first hook on.",
        series.time_figure,
    ),
    (
        "packets",
        "Packets",
        "What became of the packets of each connection.",
        bars.counts_figure,
    ),
    (
        "latency",
        "Latency",
        "The share of packets on which a hook had started within a time after they were sent.",
        bars.latency_figure,
    ),
    (
        "ticks",
        "Regularity of timed hooks",
        "Intervals between the starts of a hook with a period.",
        bars.ticks_figure,
    ),
    (
        "system_load",
        "Processor and memory",
        "Of each node's processes, once per second from the command on; 100 % is one core.",
        series.load_figure,
    ),
)


def figures_of(run: Run) -> dict[str, tuple[str, str, bytes]]:
    """By file name (without ending): title, what is seen, PNG; only what says something."""
    found = {}
    for name, title, text, draw in _FIGURES:
        figure = draw(run)
        if figure is not None:
            found[name] = (title, text, png(figure))
    return found
