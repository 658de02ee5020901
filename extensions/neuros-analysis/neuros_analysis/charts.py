"""Figures of a run: its graph, times, packets, latencies, timeline, ticks and load; of several."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Patch
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from neuros.api.packets import Numbers
from neuros.engine.metrics import TimeBudget
from neuros.project.graph import guarantee, port_names
from neuros.recording.system_load import FILE_NAME
from neuros_analysis.comparison import figures_of, labels_of
from neuros_analysis.graph_picture import Place, lay_out
from neuros_analysis.review import ReviewedRun, answers_ns, read_load

# Okabe and Ito, Color Universal Design (2008).
BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#E69F00", "#009E73", "#CC79A7"
SKY, RED, YELLOW, GREY = "#56B4E9", "#D55E00", "#F0E442", "#999999"
CYCLE = (BLUE, ORANGE, GREEN, PURPLE, SKY, RED, YELLOW, GREY)

_STATES = {"executing": GREEN, "waiting": SKY, "blocked": RED, "idle": "#DDDDDD"}
_FATES = {"consumed": BLUE, "unread": YELLOW, "in_flight": GREY, "discarded": ORANGE, "lost": RED}
_DPI, _WIDTH_IN = 110, 9.5
_POINTS = 500
_MOST_TICKS = 12
_DOTTED = (0, (2, 2))


def colour(index: int) -> str:
    """The colour of the nth of several things."""
    return CYCLE[index % len(CYCLE)]


def new_figure(height_in: float, width_in: float = _WIDTH_IN) -> Any:
    """An empty ``matplotlib`` figure; no window, no global state."""
    return Figure(figsize=(width_in, height_in), dpi=_DPI, layout="constrained")


def plain(axes: Any) -> Any:
    """Remove the frame's top and right edges and add a grid; returns the axes."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, color="#E6E6E6", linewidth=0.7)
    axes.set_axisbelow(True)
    return axes


def add_legend(figure: Any, columns: int, **options: Any) -> None:
    figure.legend(loc="outside lower center", ncols=columns, frameon=False, fontsize=8, **options)


def _stacked_bars(names: Sequence[str], parts: Mapping[str, tuple[str, Any]]) -> tuple[Any, Any]:
    """A figure and its axes: a bar of coloured parts per name, from the bottom up."""
    figure = new_figure(0.42 * len(names) + 1.2)
    axes = plain(figure.add_subplot())
    lefts = np.zeros(len(names))
    for label, (shade, lengths) in parts.items():
        axes.barh(names, lengths, left=lefts, color=shade, label=label, height=0.65)
        lefts = lefts + lengths
    add_legend(figure, 4)
    return figure, axes


def time_budget_figure(run: ReviewedRun) -> Any | None:
    """Time budgets of all nodes; ``None`` if none has reported."""
    budgets = run.time_budgets
    if not budgets:
        return None
    names = list(budgets)[::-1]
    parts = {
        state: (shade, np.array([100 * budgets[name].shares[state] for name in names]))
        for state, shade in _STATES.items()
    }
    figure, axes = _stacked_bars(names, parts)
    for bars, (_, shares) in zip(axes.containers, parts.values(), strict=True):
        texts = [f"{share:.0f}" if share >= 6 else "" for share in shares]
        axes.bar_label(bars, texts, label_type="center", fontsize=8)
    axes.set(xlabel="share of the time in which all nodes ran / %", xlim=(0, 100))
    return figure


def counts_figure(run: ReviewedRun) -> Any | None:
    """Packets of every connection: consumed, unread, discarded, lost."""
    names = list(run.connections)[::-1]
    if not names:
        return None
    figures = [run.connections[name] for name in names]
    parts = {
        fate.replace("_", " "): (shade, np.array([each.get(fate) or 0 for each in figures], float))
        for fate, shade in _FATES.items()
    }
    figure, axes = _stacked_bars(names, parts)
    texts = [f" {_count(each.get('sent'))} sent" for each in figures]
    axes.bar_label(axes.containers[-1], texts, fontsize=8)
    longest = max(np.sum([counts for _, counts in parts.values()], axis=0))
    axes.set(xlabel="packets", xlim=(0, max(longest, 1.0) * 1.18))
    return figure


def _count(value: int | None) -> str:
    return "?" if value is None else f"{value:,}"


def latency_figure(run: ReviewedRun) -> Any | None:
    """The share of packets on which a hook had started after a time; ``None`` without lists."""
    curves = {}
    for name in run.packets:
        latencies_ns = run.latencies_ns(name)
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
    add_legend(figure, 2)
    return figure


def ticks_figure(run: ReviewedRun) -> Any | None:
    """Histograms of the intervals of timed hooks; ``None`` if there are none."""
    ticks = [
        (f"{node}.{hook}", figures["ticks"])
        for node, metrics in run.nodes.items()
        for hook, figures in (metrics.get("hooks") or {}).items()
        if figures.get("ticks")
    ][:_MOST_TICKS]
    if not ticks:
        return None
    figure = new_figure(2.6 * len(ticks))
    rows = figure.subplots(len(ticks), squeeze=False)[:, 0]
    for axes, (name, each) in zip(rows, ticks, strict=True):
        from_ms, counts = zip(*each["histogram"], strict=True)
        low, high = min(from_ms), max(from_ms) + 0.1
        bins = max(1, round((high - low) / 0.1))
        width = 0.1 * max(1, -(-bins // 80))
        edges = np.arange(low, high + width, width)
        plain(axes).hist(np.array(from_ms) + 0.05, bins=edges, weights=counts, color=BLUE)
        axes.axvline(each["period_ms"], color=GREY, linestyle="--", linewidth=1)
        within = ", ".join(f"{share:.1%} within {ms}" for ms, share in each["within"].items())
        axes.set_title(
            f"{name}: period {each['period_ms']:g} ms (dashed), standard deviation"
            f" {each['std_ms']:.2f} ms\n{within}",
            fontsize=9, loc="left",
        )  # fmt: skip
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set(xlabel="interval between starts / ms", ylabel="intervals")
    return figure


def time_figure(run: ReviewedRun) -> Any | None:
    """Simulated against wall time, and the real-time factor of each second; ``None`` without."""
    timelines = {
        name: points for name, points in run.record.get("timeline", {}).items() if len(points) > 1
    }
    if not timelines:
        return None
    figure = new_figure(3.4)
    left, right = (plain(axes) for axes in figure.subplots(1, 2))
    for place, (name, points) in enumerate(timelines.items()):
        sims, walls = np.transpose(points)
        left.plot(walls, sims, color=colour(place), label=name, marker="o", markersize=3)
        passed_s, advance_s = np.diff(walls), np.diff(sims)
        is_shown = (passed_s > 0) & (advance_s >= 0)  # a reset is no advance
        factors = advance_s[is_shown] / passed_s[is_shown]
        right.step(range(1, len(factors) + 1), factors, where="mid", color=colour(place))
    low, high = left.get_xlim()
    left.axline((low, low), slope=1, color=GREY, linestyle="--", linewidth=1, label="real time")
    left.set_xlim(low, high)
    left.set(xlabel="wall time / s", ylabel="simulated time / s")
    left.legend(frameon=False, fontsize=8)
    right.axhline(1, color=GREY, linestyle="--", linewidth=1)
    right.set(xlabel="simulated second", ylabel="real-time factor", ylim=(0, None))
    return figure


def load_figure(run: ReviewedRun) -> Any | None:
    """Processor and memory of every node; ``None`` if nothing was recorded."""
    series = read_load(run.folder / FILE_NAME)
    if not series.get("time_s"):
        return None
    figure = new_figure(3.6)
    left, right = (plain(axes) for axes in figure.subplots(1, 2))
    suffix, marker = ".cpu_percent", {"marker": "o", "markersize": 3}
    groups = [name.removesuffix(suffix) for name in series if name.endswith(suffix)]
    for place, name in enumerate(groups):
        left.plot(series["time_s"], series[name + suffix], color=colour(place), **marker)
        memory_mb = np.divide(series[f"{name}.memory_bytes"], 1e6)
        right.plot(series["time_s"], memory_mb, color=colour(place), label=name, **marker)
    cores = [name for name in series if name.startswith("core")]
    if cores:  # else the file is damaged
        whole = np.sum([series[core] for core in cores], axis=0)
        label = f"whole machine, {len(cores)} core{'' if len(cores) == 1 else 's'}"
        left.plot(series["time_s"], whole, color=GREY, linestyle="--", label=label)
    left.set(xlabel="wall time / s", ylabel="processor time / % of one core", ylim=(0, None))
    right.set(xlabel="wall time / s", ylabel="resident memory / MB", ylim=(0, None))
    add_legend(figure, 5)
    return figure


_COLUMN_IN, _ROW_IN = 2.45, 1.12
_NODE, _BOX = (1.75, 0.8), (2.05, 0.8)


def graph_figure(run: ReviewedRun) -> Any | None:
    """Nodes with their time budgets, connections with their traffic and latency."""
    if not run.nodes:
        return None
    budgets = run.time_budgets
    first = run.time_owner or next(iter(run.nodes))
    known = {
        name: end
        for name, end in run.ends.items()
        if {end.source_node, end.destination_node} <= {*run.nodes}
    }
    layout = lay_out(list(run.nodes), known, first)
    places = [*layout.nodes.values(), *layout.boxes.values()]
    columns = max(place.column for place in places) + 1
    rows = max(abs(place.row) for place in places) * 2 + 1
    figure = new_figure(rows * _ROW_IN + 0.4, max(6.0, columns * _COLUMN_IN))
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.set_xlim(-_COLUMN_IN / 2, (columns - 0.5) * _COLUMN_IN)
    axes.set_ylim(-rows * _ROW_IN / 2 - 0.4, rows * _ROW_IN / 2)
    widths = dict.fromkeys(layout.nodes.values(), _NODE[0])
    widths |= dict.fromkeys(layout.boxes.values(), _BOX[0])
    for name, route in layout.routes.items():
        _draw_route(axes, route, widths, _shade(run, name), known[name].discard_limit is None)
    for name, place in layout.boxes.items():
        connection, figures, (x, y) = run.ends[name], run.connections[name], _at(place)
        losses = [f"{figures[key]:,} {key}" for key in ("discarded", "lost") if figures.get(key)]
        counts = f"{_count(figures.get('sent'))} sent, {', '.join(losses) or 'none lost'}"
        rate, latency = figures.get("rate_hz"), figures.get("latency_ms")
        speed = [] if rate is None else [f"{rate:,.0f}/s" if rate >= 10 else f"{rate:.1f}/s"]
        if latency:
            speed.append(f"{_ms(latency['p50'])} (99 %: {_ms(latency['p99'])})")
        lines = "\n".join([guarantee(connection), counts, ", ".join(speed)])
        _rectangle(axes, x, y, _BOX, "white", _shade(run, name))
        _write(axes, x, y + 0.25, _short(port_names(connection), 30), 8, weight="bold")
        _write(axes, x, y - 0.11, lines, 6.8, linespacing=1.25)
    for name, place in layout.nodes.items():
        _draw_node(axes, name, place, budgets.get(name))
    handles = [
        *(Patch(color=shade, label=state) for state, shade in _STATES.items()),
        Line2D([], [], color=GREY, linestyle=_DOTTED, label="no discard limit"),
        Line2D([], [], color=BLUE, label="discard limit"),
        Line2D([], [], color=RED, label="blocked its sender over 10 % of the time"),
    ]
    axes.legend(
        handles=handles, loc="lower center", ncols=4, frameon=False, fontsize=7.5,
        bbox_to_anchor=(0.5, -0.02 - 0.06 / rows), handlelength=1.6,
    )  # fmt: skip
    return figure


def _at(place: Place) -> tuple[float, float]:
    return place.column * _COLUMN_IN, -place.row * _ROW_IN


def _shade(run: ReviewedRun, name: str) -> str:
    """The colour of a connection: red if it blocked its sender over 10 % of the time."""
    spent = run.time_budgets.get(run.ends[name].source_node)
    if spent and run.running_s and spent.blocked.get(name, 0.0) > 0.1 * run.running_s:
        return RED
    return BLUE if run.ends[name].discard_limit is not None else GREY


def _draw_route(
    axes: Any, route: Sequence[Place], widths: Mapping[Place, float], shade: str, is_dotted: bool
) -> None:
    """A line from the sender's side to the receiver's; its end has the arrow."""
    for number, (a, b) in enumerate(itertools.pairwise(route)):
        (x, y), (to_x, to_y) = _at(a), _at(b)
        side = 1 if to_x > x else -1
        is_last = number == len(route) - 2
        from_half, to_half = widths.get(a, 0.0) / 2, widths.get(b, 0.0) / 2
        line = FancyArrowPatch(
            (x + side * from_half, y), (to_x - side * to_half, to_y),
            arrowstyle="-|>" if is_last else "-", mutation_scale=12, shrinkA=0, shrinkB=0,
            color=shade, linewidth=1.8, linestyle=_DOTTED if is_dotted else "solid",
        )  # fmt: skip
        axes.add_patch(line)


def _write(axes: Any, x: float, y: float, text: str, size: float, **options: Any) -> None:
    axes.text(x, y, text, ha="center", va="center", fontsize=size, **options)


def _ms(value: float) -> str:
    return f"{value:.2f} ms" if value < 10 else f"{value:,.0f} ms"


def _draw_node(axes: Any, name: str, place: Place, spent: TimeBudget | None) -> None:
    x, y = _at(place)
    _rectangle(axes, x, y, _NODE, "#F7F7F7", "#333333")
    _write(axes, x, y + 0.2, _short(name, 22), 9.5, weight="bold")
    if spent is None or spent.total_s <= 0:
        _write(axes, x, y - 0.1, "never reported", 7)
        return
    hook, busy_s = spent.busiest_hook
    if hook:
        _write(axes, x, y - 0.03, _short(f"{hook} {spent.share(busy_s):.0%}", 28), 7)
    left = x - _NODE[0] / 2 + 0.1
    for state, share in spent.shares.items():
        wide = share * (_NODE[0] - 0.2)
        axes.barh(y - 0.23, wide, left=left, height=0.13, color=_STATES[state], linewidth=0)
        left += wide


def _rectangle(
    axes: Any, x: float, y: float, size: tuple[float, float], face: str, edge: str
) -> None:
    width, height = size
    axes.add_patch(
        FancyBboxPatch(
            (x - width / 2, y - height / 2), width, height,
            boxstyle="round,pad=0,rounding_size=0.06", facecolor=face, edgecolor=edge,
        )
    )  # fmt: skip


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


_SECOND_NS = 1_000_000_000
_MOST_LINES = 4_000
_ENLARGED_PACKETS = 12
"""The enlarged part shows so many packets of the busiest connection."""
_HALF = 0.3
_DASHES = (0, (2, 1.5))
_Colours = dict[tuple[str, str], str]
_HOOKS = (GREEN, SKY, PURPLE, RED, GREY, YELLOW)
"""Colours of bars, which lines do not have."""
_CROWD = 60
"""From this number on lines of a kind are drawn thinner."""


def timeline_figure(run: ReviewedRun) -> Any | None:
    """The first second in which all nodes ran, and a part of it enlarged; ``None`` without lists.

    A lane of hooks for each node, packets and acknowledgements between them.
    """
    running = {name: trace.starts_ns[trace.is_running] for name, trace in run.traces.items()}
    start_ns = max((int(starts[0]) for starts in running.values() if len(starts)), default=None)
    if start_ns is None:
        return None
    hooks = [(n, *each) for n in run.nodes if n in run.traces for each in run.traces[n].hooks]
    # Initialise hooks, which are seldom visible, get the last colours.
    hooks.sort(key=lambda each: each[2] == "initialise")
    names = dict.fromkeys((node, hook) for node, hook, _ in hooks)
    colours = {each: _HOOKS[place % len(_HOOKS)] for place, each in enumerate(names)}
    nodes = [name for name in run.nodes if name in run.traces]
    figure = new_figure(2 * (0.62 * len(nodes) + 1.0) + 0.6)
    above, below = figure.subplots(2, 1)
    close_ns = _SECOND_NS
    for packets in run.packets.values():
        after = packets.sent_ns[packets.sent_ns >= start_ns][: _ENLARGED_PACKETS + 1]
        if len(after) > _ENLARGED_PACKETS:
            close_ns = min(close_ns, int(after[-1]) - start_ns)
    close_ns = max(close_ns, 1_000)
    _draw(above, run, colours, start_ns, _SECOND_NS)
    above.set_title("the first second in which all nodes ran", fontsize=10, loc="left")
    _draw(below, run, colours, start_ns, close_ns)
    close_ms = float(f"{close_ns / 1e6:.3g}")
    below.set_title(f"the first {close_ms:g} ms of it", fontsize=10, loc="left")
    shown = {(node, hook) for node, hook, kind in hooks if kind != "initialise"}
    handles: list[Any] = [
        Patch(color=shade, label=".".join(each)) for each, shade in colours.items() if each in shown
    ]
    handles += [
        Line2D([], [], color=BLUE, label="packet: sent, until a hook starts on it"),
        Line2D([], [], color=ORANGE, linestyle=_DASHES, label="acknowledgement"),
    ]
    add_legend(figure, 3, handles=handles)
    return figure


def _draw(axes: Any, run: ReviewedRun, colours: _Colours, start_ns: int, length_ns: int) -> None:
    nodes = [name for name in run.nodes if name in run.traces]
    row = {name: len(nodes) - 1 - place for place, name in enumerate(nodes)}
    for name in nodes:
        trace = run.traces[name]
        is_here = (trace.ends_ns >= start_ns) & (trace.starts_ns < start_ns + length_ns)
        for place, (hook, _) in enumerate(trace.hooks):
            chosen = is_here & (trace.which == place)
            starts_ns = trace.starts_ns[chosen]
            spans = np.column_stack([starts_ns - start_ns, trace.ends_ns[chosen] - starts_ns]) / 1e6
            # The edge keeps executions visible that are shorter than a dot.
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
    axes.set_xlim(0, length_ns / 1e6)
    axes.set_xlabel("wall time / ms")
    axes.grid(visible=False, axis="y")


def _draw_packets(
    axes: Any, run: ReviewedRun, name: str, rows: tuple[int, int], window: tuple[int, int]
) -> None:
    sender, receiver = rows
    if sender == receiver:
        return
    side = 1 if receiver > sender else -1
    away, towards = sender + side * _HALF, receiver - side * _HALF
    flights_ns = run.flights_ns(name)
    flights = _within(flights_ns, window) if flights_ns is not None else None
    end = run.ends[name]
    answers = answers_ns(run.traces.get(end.source_node), run.packets[name], end.index)
    for times, ends, shade, dashes in (
        (flights, (away, towards), BLUE, "solid"),
        (_within(answers, window), (towards, away), ORANGE, _DASHES),
    ):
        if times is not None and len(times):
            is_crowd = len(times) > _CROWD
            segments: Any = np.stack([times, np.broadcast_to(ends, times.shape)], axis=2)
            lines = LineCollection(
                segments, colors=shade, linestyles=[dashes], zorder=3,
                linewidth=0.35 if is_crowd else 0.9, alpha=0.6 if is_crowd else 1,
            )  # fmt: skip
            axes.add_collection(lines)


def _within(times_ns: Numbers, window: tuple[int, int]) -> Numbers:
    start_ns, length_ns = window
    is_here = (times_ns[:, 1] >= start_ns) & (times_ns[:, 0] < start_ns + length_ns)
    found: Numbers = (times_ns[is_here][:_MOST_LINES] - start_ns) / 1e6
    return found


def comparison_figure(runs: Sequence[ReviewedRun]) -> Any | None:
    """Real-time factor, consumed packets, latency, executing share; ``None`` if no run has any."""
    found = figures_of(runs)
    nothing: list[float | None] = [None for _ in runs]
    connections = dict.fromkeys(name for run in runs for name in run.connections)
    nodes = dict.fromkeys(name for run in runs for name in run.nodes)
    panels = {
        "real-time factor": {"": "real-time factor"},
        "packets consumed / %": {name: f"{name}: consumed / %" for name in connections},
        "median latency / ms": {name: f"{name}: median latency / ms" for name in connections},
        "executing / % of the time": {name: f"{name}: executing / %" for name in nodes},
    }
    panels = {
        title: rows for title, rows in panels.items() if any(key in found for key in rows.values())
    }
    if not panels:
        return None
    bar = 0.8 / len(runs)
    heights = [max(1.0, len(rows) * (0.2 + 0.16 * len(runs))) for rows in panels.values()]
    figure = new_figure(sum(heights) + 0.75 * len(panels) + 0.4)
    ratios = {"height_ratios": heights}
    all_axes = figure.subplots(len(panels), squeeze=False, gridspec_kw=ratios)[:, 0]
    for axes, (title, rows) in zip(all_axes, panels.items(), strict=True):
        places = np.arange(len(rows))[::-1]
        for number, label in enumerate(labels_of(runs)):
            values = [found.get(key, nothing)[number] for key in rows.values()]
            offsets = places + 0.4 - bar * (number + 0.5)
            lengths, height = [value or 0.0 for value in values], bar * 0.92
            bars = axes.barh(offsets, lengths, height, color=colour(number), label=label)
            texts = [" ?" if value is None else f" {value:.3g}" for value in values]
            axes.bar_label(bars, texts, fontsize=7)
        plain(axes).set_yticks(places, [*rows], fontsize=8)
        if [*rows] == [""]:
            axes.tick_params(axis="y", length=0)
        axes.set_title(title, fontsize=10, loc="left")
        axes.margins(x=0.1)
        axes.grid(visible=False, axis="y")
    handles, labels = all_axes[0].get_legend_handles_labels()
    add_legend(figure, 4, handles=handles, labels=labels)
    return figure


_PANEL_COLUMNS = 3


def distributions_figure(panels: Mapping[str, Mapping[str, Numbers]]) -> Any:
    """Cumulative shares of durations or delays, a panel for each hook or connection.

    Args:
        panels: by title, and by the label of the curve: seconds, (n,). All panels have the same
            labels in the same order.
    """
    rows = -(-len(panels) // _PANEL_COLUMNS)
    figure = new_figure(2.2 * max(1, rows) + 0.4)
    all_axes = figure.subplots(max(1, rows), _PANEL_COLUMNS, squeeze=False).ravel()
    for axes in all_axes[len(panels) :]:
        axes.set_axis_off()
    for axes, (title, curves) in zip(all_axes, panels.items(), strict=False):
        for place, (label, values_s) in enumerate(curves.items()):
            shares = np.linspace(0, 100, min(_POINTS, len(values_s) + 1))
            ms = np.maximum(np.percentile(values_s, shares) * 1e3, 1e-3)
            axes.plot(ms, shares, ("-", "--")[place % 2], color=colour(place), label=label)
        plain(axes).set_xscale("log")
        low, high = axes.get_xlim()
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 200 * low else (1,)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylim(0, 100)
        axes.set_title(title, fontsize=7.5, loc="left")
        axes.set_xlabel("ms", fontsize=7)
        axes.set_ylabel("share / %", fontsize=7)
        axes.tick_params(labelsize=7)
    handles, labels = all_axes[0].get_legend_handles_labels()
    add_legend(figure, 4, handles=handles, labels=labels)
    return figure
