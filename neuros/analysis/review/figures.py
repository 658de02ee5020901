"""Figures of one run: its graph, times, packets, latencies, ticks and load."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuros.analysis.review.run import Run
from neuros.engine.time_budget import TimeBudget
from neuros.project.graph import guarantee, port_names
from neuros.project.layout import Place, lay_out
from neuros.recording.system_load import FILE_NAME

# Okabe and Ito, Color Universal Design (2008).
BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#E69F00", "#009E73", "#CC79A7"
SKY, RED, YELLOW, GREY = "#56B4E9", "#D55E00", "#F0E442", "#999999"
CYCLE = (BLUE, ORANGE, GREEN, PURPLE, SKY, RED, YELLOW, GREY)

STATES = {
    "executing": GREEN,
    "waiting": SKY,
    "blocked": RED,
    "idle": "#DDDDDD",
}
DPI = 110
WIDTH_IN = 9.5


def colour(index: int) -> str:
    """The colour of the nth of several things."""
    return CYCLE[index % len(CYCLE)]


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Any:
    """An empty ``matplotlib`` figure; no window, no global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def plain(axes: Any) -> Any:
    """Leave out the frame where nothing is read off; returns the axes."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, color="#E6E6E6", linewidth=0.7)
    axes.set_axisbelow(True)
    return axes


_FATES = {"consumed": BLUE, "unread": YELLOW, "discarded": ORANGE, "lost": RED}
_POINTS = 500
_MOST_TICKS = 12


def time_budget_figure(run: Run) -> Any | None:
    """Time budgets of all nodes; ``None`` if none has reported."""
    budgets = run.time_budgets
    if not budgets:
        return None
    names = list(budgets)[::-1]
    figure = new_figure(0.42 * len(names) + 1.2)
    axes = plain(figure.add_subplot())
    lefts = np.zeros(len(names))
    for state, shade in STATES.items():
        shares = np.array([100 * budgets[name].shares[state] for name in names])
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
    """Packets of every connection: consumed, unread, discarded, lost."""
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


_SUFFIX = ".cpu_percent"


def time_figure(run: Run) -> Any | None:
    """Simulated against wall time, and the real-time factor of each second; ``None`` without."""
    timelines = {
        name: points for name, points in run.record.get("timeline", {}).items() if len(points) > 1
    }
    if not timelines:
        return None
    figure = new_figure(3.4)
    left, right = (plain(axes) for axes in figure.subplots(1, 2))
    for place, (name, points) in enumerate(timelines.items()):
        sims, walls = zip(*points, strict=True)
        left.plot(walls, sims, color=colour(place), label=name, marker="o", markersize=3)
        factors = [
            (b[0] - a[0]) / (b[1] - a[1]) for a, b in itertools.pairwise(points) if b[1] > a[1]
        ]
        right.step(range(1, len(factors) + 1), factors, where="mid", color=colour(place))
    low, high = left.get_xlim()
    left.axline((low, low), slope=1, color=GREY, linestyle="--", linewidth=1, label="real time")
    left.set_xlim(low, high)
    left.set(xlabel="wall time / s", ylabel="simulated time / s")
    left.legend(frameon=False, fontsize=8)
    right.axhline(1, color=GREY, linestyle="--", linewidth=1)
    right.set(xlabel="simulated second", ylabel="real-time factor", ylim=(0, None))
    return figure


def load_figure(run: Run) -> Any | None:
    """Processor and memory of every node; ``None`` if nothing was recorded."""
    series = read_load(run.folder / FILE_NAME)
    if not series.get("time_s"):
        return None
    figure = new_figure(3.6)
    left, right = (plain(axes) for axes in figure.subplots(1, 2))
    groups = [name.removesuffix(_SUFFIX) for name in series if name.endswith(_SUFFIX)]
    marker = {"marker": "o", "markersize": 3}
    for place, name in enumerate(groups):
        left.plot(series["time_s"], series[name + _SUFFIX], color=colour(place), **marker)
        memory = [each / 1e6 for each in series[f"{name}.memory_bytes"]]
        right.plot(series["time_s"], memory, color=colour(place), label=name, **marker)
    cores = [name for name in series if name.startswith("core")]
    whole = [sum(each) for each in zip(*(series[core] for core in cores), strict=True)]
    label = f"whole machine, {len(cores)} core{'' if len(cores) == 1 else 's'}"
    left.plot(series["time_s"], whole, color=GREY, linestyle="--", label=label)
    left.set(xlabel="wall time / s", ylabel="processor time / % of one core", ylim=(0, None))
    right.set(xlabel="wall time / s", ylabel="resident memory / MB", ylim=(0, None))
    figure.legend(loc="outside lower center", ncols=5, frameon=False, fontsize=8)
    return figure


def read_load(file: Path) -> dict[str, list[float]]:
    """The columns of ``system_load.csv``, NaN where a cell is empty; none if there is no file.

    The last row of a run that was cut off may be broken, and is left out.
    """
    try:
        with open(file, encoding="utf-8", newline="") as lines:
            header, *rows = csv.reader(lines)
    except (OSError, ValueError):
        return {}
    series: dict[str, list[float]] = {name: [] for name in header}
    for row in rows:
        try:
            numbers = [float(cell) if cell else float("nan") for cell in row]
        except ValueError:
            continue
        if len(numbers) == len(header):
            for name, number in zip(header, numbers, strict=True):
                series[name].append(number)
    return series


_COLUMN_IN, _ROW_IN = 2.45, 1.12
_NODE, _BOX = (1.75, 0.8), (2.05, 0.8)


def graph_figure(run: Run) -> Any | None:
    """Nodes with how they spent their time, connections with what they carried and how fast."""
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
        colour = _colour(run, name, budgets)
        _draw_route(axes, route, widths, colour, known[name].discard_limit is None)
    for name, place in layout.boxes.items():
        _draw_box(axes, run, name, place, _colour(run, name, budgets))
    for name, place in layout.nodes.items():
        _draw_node(axes, name, place, budgets.get(name))
    _draw_key(axes, rows)
    return figure


def _at(place: Place) -> tuple[float, float]:
    return place.column * _COLUMN_IN, -place.row * _ROW_IN


def _colour(run: Run, name: str, budgets: Mapping[str, TimeBudget]) -> str:
    """Red where the sender was held up for long."""
    spent = budgets.get(run.ends[name].source_node)
    if spent and run.running_s and spent.blocked.get(name, 0.0) > 0.1 * run.running_s:
        return RED
    return BLUE if run.ends[name].discard_limit is not None else GREY


def _draw_route(
    axes: Any, route: Sequence[Place], widths: Mapping[Place, float], colour: str, is_dotted: bool
) -> None:
    """A line from the sender's side to the receiver's; its end has the arrow."""
    from matplotlib.patches import FancyArrowPatch

    for number, (a, b) in enumerate(itertools.pairwise(route)):
        (x, y), (to_x, to_y) = _at(a), _at(b)
        side = 1 if to_x > x else -1
        is_last = number == len(route) - 2
        from_half, to_half = widths.get(a, 0.0) / 2, widths.get(b, 0.0) / 2
        axes.add_patch(
            FancyArrowPatch(
                (x + side * from_half, y),
                (to_x - side * to_half, to_y),
                arrowstyle="-|>" if is_last else "-",
                mutation_scale=12,
                shrinkA=0,
                shrinkB=0,
                color=colour,
                linewidth=1.8,
                linestyle=(0, (2, 2)) if is_dotted else "solid",
            )
        )


def _draw_box(axes: Any, run: Run, name: str, place: Place, colour: str) -> None:
    x, y = _at(place)
    _rectangle(axes, x, y, _BOX, "white", colour)
    connection, figures = run.ends[name], run.connections[name]
    ports = port_names(connection)
    lines = [guarantee(connection), _counts(figures), _speed(figures)]
    axes.text(x, y + 0.25, _short(ports, 30), ha="center", va="center", fontsize=8, weight="bold")
    axes.text(
        x, y - 0.11, "\n".join(lines), ha="center", va="center", fontsize=6.8, linespacing=1.25
    )


def _counts(figures: Mapping[str, Any]) -> str:
    lost = [
        f"{figures[key]:,} {key}" for key in ("discarded", "lost") if (figures.get(key) or 0) > 0
    ]
    sent = figures.get("sent")
    return f"{'?' if sent is None else f'{sent:,}'} sent, {', '.join(lost) or 'none lost'}"


def _speed(figures: Mapping[str, Any]) -> str:
    rate, latency = figures.get("rate_hz"), figures.get("latency_ms")
    parts = [] if rate is None else [f"{rate:,.0f}/s" if rate >= 10 else f"{rate:.1f}/s"]
    if latency:
        parts.append(f"{_ms(latency['p50'])} (99 %: {_ms(latency['p99'])})")
    return ", ".join(parts)


def _ms(value: float) -> str:
    return f"{value:.2f} ms" if value < 10 else f"{value:,.0f} ms"


def _draw_node(axes: Any, name: str, place: Place, spent: TimeBudget | None) -> None:
    x, y = _at(place)
    width, _height = _NODE
    _rectangle(axes, x, y, _NODE, "#F7F7F7", "#333333")
    axes.text(x, y + 0.2, _short(name, 22), ha="center", va="center", fontsize=9.5, weight="bold")
    if spent is None or spent.total_s <= 0:
        axes.text(x, y - 0.1, "never reported", ha="center", va="center", fontsize=7)
        return
    hook, busy_s = spent.busiest_hook
    if hook:
        text = _short(f"{hook} {spent.share(busy_s):.0%}", 28)
        axes.text(x, y - 0.03, text, ha="center", va="center", fontsize=7)
    left = x - width / 2 + 0.1
    for state, share in spent.shares.items():
        wide = share * (width - 0.2)
        axes.barh(y - 0.23, wide, left=left, height=0.13, color=STATES[state], linewidth=0)
        left += wide


def _draw_key(axes: Any, rows: float) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    lines = (("no discard limit", GREY, (0, (2, 2))), ("discard limit", BLUE, "solid"))
    handles = [
        *(Patch(color=colour, label=state) for state, colour in STATES.items()),
        *(Line2D([], [], color=c, linestyle=style, label=label) for label, c, style in lines),
        Line2D([], [], color=RED, label="blocked its sender over 10 % of the time"),
    ]
    axes.legend(
        handles=handles, loc="lower center", ncols=4, frameon=False, fontsize=7.5,
        bbox_to_anchor=(0.5, -0.02 - 0.06 / rows), handlelength=1.6,
    )  # fmt: skip


def _rectangle(
    axes: Any, x: float, y: float, size: tuple[float, float], face: str, edge: str
) -> None:
    from matplotlib.patches import FancyBboxPatch

    width, height = size
    axes.add_patch(
        FancyBboxPatch(
            (x - width / 2, y - height / 2), width, height,
            boxstyle="round,pad=0,rounding_size=0.06", facecolor=face, edgecolor=edge,
        )
    )  # fmt: skip


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
