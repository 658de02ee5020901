"""The figure of a project's nodes and connections, with what happened there written on them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from neuros.core.spending import Spending
from neuros.observe.review.run import Run
from neuros.observe.review.style import BLUE, GREY, RED, STATES, new_figure
from neuros.project.graph import guarantee, port_names
from neuros.project.layout import Place, lay_out

_COLUMN_IN, _ROW_IN = 2.45, 1.12
_NODE, _BOX = (1.75, 0.8), (2.05, 0.8)


def graph_figure(run: Run) -> Any | None:
    """Nodes with how they spent their time, connections with what they carried and how fast."""
    if not run.nodes:
        return None
    spending = run.spending
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
        colour = _colour(run, name, spending)
        _draw_route(axes, route, widths, colour, known[name].discard_limit is None)
    for name, place in layout.boxes.items():
        _draw_box(axes, run, name, place, _colour(run, name, spending))
    for name, place in layout.nodes.items():
        _draw_node(axes, name, place, spending.get(name))
    _draw_key(axes, rows)
    return figure


def _at(place: Place) -> tuple[float, float]:
    return place.column * _COLUMN_IN, -place.row * _ROW_IN


def _colour(run: Run, name: str, spending: Mapping[str, Spending]) -> str:
    """Red where the sender was held up for long."""
    spent = spending.get(run.ends[name].source_node)
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


def _draw_node(axes: Any, name: str, place: Place, spent: Spending | None) -> None:
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
