"""How regular a tick is: a hook of NeuROS and a timer in ``rclpy.spin``, measured alike."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks.bare_nodes import results
from benchmarks.launching import RUN_S, launch, project_of_plugins
from benchmarks.reproduce.experiment import Entry
from benchmarks.reproduce.intervals import INTERVAL_COLUMNS, interval_figures, intervals_of
from benchmarks.reproduce.kinds import Kind, Reading, Readings
from benchmarks.reproduce.page import Section
from benchmarks.reproduce.published import TICK_FIGURES, TICKS
from benchmarks.reproduce.tables import Layout, Remark
from neuros.api.run_record import open_run

PERIOD_S = 1.0
PARTS = {"neuros": "NeuROS", "rclpy": "bare rclpy timer"}
_FEWEST = 3
_NODE = "ticker"
_MOMENTS = "result.json"

_TEXT = (
    "An interval is the time between two starts of the callback, noted in the callback; it is"
    f" {PERIOD_S:g} s if the timer is right, as in the published experiment. Shares are of the"
    " intervals that are off by no more than so much. Published intervals are between lines of the"
    " log, so that they have the time to write it in them."
)


def run(name: str, folder: Path, wall_s: float, backend: str) -> None:
    """Let one of the two tick for so long."""
    count = round(wall_s / PERIOD_S)
    if name == "rclpy":
        timer = {"role": "timer", "period_s": PERIOD_S, "count": count}
        (moments_ns,) = results([[timer]], [0])
        folder.mkdir(parents=True)
        (folder / _MOMENTS).write_text(json.dumps(moments_ns))
        return
    node = {
        "name": _NODE,
        "container": "neuros_python",
        "plugin": "ticker.py",
        "environment": {"PERIOD_S": str(PERIOD_S), "COUNT": str(count)},
    }
    with project_of_plugins({"nodes": [node]}) as project:
        launch(project, folder, backend, timeout_s=RUN_S + 2 * wall_s)


def read(folder: Path, entry: Entry) -> Reading:
    """What a run has left behind. Raises ``OSError`` or ``UsageError`` where that is not all."""
    backend, file = "", folder / _MOMENTS
    if entry.name == "neuros":
        backend, file = open_run(folder).record["backend"], folder / _NODE / _MOMENTS
    ticks = intervals_of(json.loads(file.read_text()), PERIOD_S)
    return Reading(entry.title, entry.name, interval_figures(ticks), {"backend": backend}, ticks)


LAYOUT = Layout("tick_intervals", [Remark("back end", "backend"), *INTERVAL_COLUMNS])


def show(readings: Readings, folder: Path) -> Sequence[Section]:
    """The table and the histograms."""
    from benchmarks.reproduce.tick_figures import draw_ticks

    ticks = {
        title: [each.series for each in readings[name]]
        for name, title in PARTS.items()
        if name in readings
    }
    picture = draw_ticks(ticks, folder / "tick_histogram.png")
    return [Section("Tick interval", [_TEXT], LAYOUT.fill(*_beside(readings)), [picture])]


def _beside(readings: Readings) -> tuple[dict[str, str], Readings]:
    """Each part, and what was published of it in the line below."""
    titles, rows = {}, dict(readings)
    for name, title in PARTS.items():
        other = f"{name}, published"
        titles |= {name: f"{title}, here", other: f"{title}, published"}
        figures = {f"within_{ms}ms_percent": share for ms, share in TICKS[name].items()}
        figures |= TICK_FIGURES[name]
        rows[other] = [Reading(other, other, figures, {}, None)]
    return titles, rows


KIND = Kind(
    title="The regularity of ticks",
    introduction=(
        f"A hook of NeuROS that is to run every {PERIOD_S:g} s, and a timer of the same"
        " period in rclpy.spin without NeuROS, one after the other."
    ),
    parts=PARTS,
    run=run,
    read=read,
    show=show,
    shortest_s=_FEWEST * PERIOD_S,
    duration_s=60.0,
)
