"""How figures look: sizes, and colours that people who see few colours can tell apart."""

from __future__ import annotations

from typing import Any

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
