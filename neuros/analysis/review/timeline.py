"""Timeline figure: a lane of hooks for each node, packets and acknowledgements between them."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from neuros.analysis.packets import Numbers
from neuros.analysis.review.figures import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    YELLOW,
    new_figure,
    plain,
)
from neuros.analysis.review.run import Run

_SECOND_NS = 1_000_000_000
_MOST_LINES = 4_000
_CLOSE_LOOK = 12
"""Packets on the busiest connection that the enlarged part shows."""
_HALF = 0.3
_DASHES = (0, (2, 1.5))
_Colours: TypeAlias = dict[tuple[str, str], str]
_HOOKS = (GREEN, SKY, PURPLE, RED, GREY, YELLOW)
"""Colours of bars: those that lines do not have."""
_CROWD = 60
"""Lines of a kind above which they are drawn finer."""


def first_second(run: Run) -> int | None:
    """When the last node had begun to run hooks (ns); ``None`` if no executions are listed."""
    firsts = [
        int(trace.starts_ns[trace.is_running][0])
        for trace in run.traces.values()
        if trace.is_running.any()
    ]
    return max(firsts, default=None)


def timeline_figure(run: Run) -> Any | None:
    """The first second in which all nodes ran, and a part of it enlarged."""
    start_ns = first_second(run)
    if start_ns is None:
        return None
    nodes = [name for name in run.nodes if name in run.traces]
    colours = _colours(run, nodes)
    figure = new_figure(2 * (0.62 * len(nodes) + 1.0) + 0.6)
    above, below = figure.subplots(2, 1)
    close_ns = _close_look_ns(run, start_ns)
    _draw(above, run, colours, start_ns, _SECOND_NS)
    above.set_title("the first second in which all nodes ran", fontsize=10, loc="left")
    _draw(below, run, colours, start_ns, close_ns)
    close_ms = float(f"{close_ns / 1e6:.3g}")
    below.set_title(f"the first {close_ms:g} ms of it", fontsize=10, loc="left")
    _legend(figure, run, colours)
    return figure


def _colours(run: Run, nodes: list[str]) -> _Colours:
    """A colour for each hook; those of initialise hooks, which are seldom seen, come last."""
    hooks = [(name, *each) for name in nodes for each in run.traces[name].hooks]
    hooks.sort(key=lambda each: each[2] == "initialise")
    names = dict.fromkeys((node, hook) for node, hook, _ in hooks)
    return {each: _HOOKS[place % len(_HOOKS)] for place, each in enumerate(names)}


def _close_look_ns(run: Run, start_ns: int) -> int:
    """A length that shows a dozen packets of the busiest connection."""
    shortest = _SECOND_NS
    for packets in run.packets.values():
        after = packets.sent_ns[packets.sent_ns >= start_ns][: _CLOSE_LOOK + 1]
        if len(after) > _CLOSE_LOOK:
            shortest = min(shortest, int(after[-1]) - start_ns)
    return max(shortest, 1_000)


def _draw(axes: Any, run: Run, colours: _Colours, start_ns: int, length_ns: int) -> None:
    nodes = [name for name in run.nodes if name in run.traces]
    row = {name: len(nodes) - 1 - place for place, name in enumerate(nodes)}
    unit = 1e6
    for name in nodes:
        trace = run.traces[name]
        is_here = (trace.ends_ns >= start_ns) & (trace.starts_ns < start_ns + length_ns)
        for place, (hook, _) in enumerate(trace.hooks):
            chosen = is_here & (trace.which == place)
            spans = np.column_stack(
                [
                    (trace.starts_ns[chosen] - start_ns) / unit,
                    (trace.ends_ns[chosen] - trace.starts_ns[chosen]) / unit,
                ]
            )
            # A line around each keeps visible what is shorter than a dot.
            shade = colours[name, hook]
            axes.broken_barh(
                spans, (row[name] - _HALF, 2 * _HALF), facecolor=shade, edgecolor=shade,
                linewidth=0.4, zorder=2,
            )  # fmt: skip
    for name, end in run.ends.items():
        if end.source_node in row and end.destination_node in row:
            ends = row[end.source_node], row[end.destination_node]
            _draw_packets(axes, run, name, ends, (start_ns, length_ns))
    plain(axes)
    axes.set_yticks([row[name] for name in nodes], nodes)
    axes.set_ylim(-0.6, len(nodes) - 0.4)
    axes.set_xlim(0, length_ns / unit)
    axes.set_xlabel("wall time / ms")
    axes.grid(visible=False, axis="y")


def _draw_packets(
    axes: Any, run: Run, name: str, rows: tuple[int, int], window: tuple[int, int]
) -> None:
    from matplotlib.collections import LineCollection

    sender, receiver = rows
    if sender == receiver:
        return
    side = 1 if receiver > sender else -1
    away, towards = sender + side * _HALF, receiver - side * _HALF
    may_lose = run.ends[name].discard_limit is None
    for times, segments, shade, dashes in (
        (_flights(run, name, window, may_lose), (away, towards), BLUE, "solid"),
        (_answers(run, name, window), (towards, away), ORANGE, _DASHES),
    ):
        if times is not None:
            is_crowd = len(times) > _CROWD
            lines = LineCollection(
                _segments(times, *segments), colors=shade, linestyles=[dashes], zorder=3,
                linewidth=0.35 if is_crowd else 0.9, alpha=0.6 if is_crowd else 1,
            )  # fmt: skip
            axes.add_collection(lines)


def _flights(run: Run, name: str, window: tuple[int, int], may_lose: bool) -> Numbers | None:
    """Milliseconds of sending and of the start on it, for packets of the window, (n, 2)."""
    packets = run.packets[name]
    latencies = packets.latencies_ns(may_lose=may_lose and _has_lost(run, name))
    if latencies is None or not len(latencies):
        return None
    taken_ns = packets.taken_ns[: len(latencies)]
    return _within(np.column_stack([taken_ns - latencies, taken_ns]), window)


def _has_lost(run: Run, name: str) -> bool:
    figures = run.connections[name]
    return bool(figures.get("sent") != figures.get("received"))


def _answers(run: Run, name: str, window: tuple[int, int]) -> Numbers | None:
    """Milliseconds of acknowledgements: from the start on a packet to when its sender knew.

    They are cumulative: one is drawn from the last packet that it counts.
    """
    end = run.ends[name]
    trace = run.traces.get(end.source_node)
    if trace is None:
        return None
    credits = trace.credits[trace.credits[:, 0] == end.index]
    taken, taken_ns = run.packets[name].taken, run.packets[name].taken_ns
    places, first = np.unique(taken, return_index=True)
    found = np.searchsorted(places, credits[:, 1])
    is_known = found < len(places)
    is_known[is_known] &= places[found[is_known]] == credits[is_known, 1]
    times = np.column_stack([taken_ns[first[found[is_known]]], credits[is_known, 2]])
    return _within(times, window)


def _within(times_ns: Numbers, window: tuple[int, int]) -> Numbers:
    start_ns, length_ns = window
    is_here = (times_ns[:, 1] >= start_ns) & (times_ns[:, 0] < start_ns + length_ns)
    found: Numbers = (times_ns[is_here][:_MOST_LINES] - start_ns) / 1e6
    return found


def _segments(times: Numbers, from_row: float, to_row: float) -> Any:
    """Line segments, (n, 2, 2)."""
    rows = np.broadcast_to(np.array([from_row, to_row]), times.shape)
    return np.stack([times, rows], axis=2)


def _legend(figure: Any, run: Run, colours: _Colours) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    kinds = {(n, hook): kind for n, t in run.traces.items() for hook, kind in t.hooks}
    handles: list[Any] = [
        Patch(color=shade, label=".".join(each))
        for each, shade in colours.items()
        if kinds[each] != "initialise"
    ]
    handles += [
        Line2D([], [], color=BLUE, label="packet: sent, until a hook starts on it"),
        Line2D([], [], color=ORANGE, linestyle=_DASHES, label="acknowledgement"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
