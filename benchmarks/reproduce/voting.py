"""What the orchestration adds to tasks that run at once: the example ``voting``.

Three voters think for 5 s each, at the same time; the chair asks again when all have voted.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.launching import RUN_S, launch
from benchmarks.machine import ROOT
from benchmarks.reproduce.experiment import Entry
from benchmarks.reproduce.intervals import interval_figures, intervals_of
from benchmarks.reproduce.kinds import Kind, Reading, Readings
from benchmarks.reproduce.page import Section
from benchmarks.reproduce.published import VOTING
from benchmarks.reproduce.tables import Layout, Ours, Remark
from neuros.api.packets import read_packets
from neuros.api.run_record import open_run

PROJECT = ROOT / "examples" / "2_synchronisation" / "voting"
THINK_S = 5.0
PARTS = {"voting": "three voters"}
VOTERS = ("ann", "bob", "cleo")
_ASKED = "chair.question -> ann.question"
_PUBLISHED = "three voters, published"

LAYOUT = Layout(
    "voting_intervals",
    [
        Remark("back end", "backend"),
        Ours("intervals", "intervals", "{:.0f}"),
        Ours("mean, s", "mean_s", "{:.4f}"),
        Ours("more than 5 s, ms", "added_ms", "{:.2f}"),
        Ours("standard deviation, ms", "std_ms", "{:.2f}"),
        Ours("longest, s", "max_s", "{:.4f}"),
    ],
)


def run(name: str, folder: Path, wall_s: float, backend: str) -> None:
    """As many questions as there is time for; the last answers end the project."""
    questions = ["yes or no"] * round(wall_s / THINK_S)
    settings = {f"nodes.{voter}.environment.THINK_SECONDS": THINK_S for voter in VOTERS}
    launch(
        PROJECT,
        folder,
        backend,
        settings={**settings, "nodes.chair.environment.QUESTIONS": ", ".join(questions)},
        options=["-m", "--digests"],
        timeout_s=RUN_S + len(VOTERS) * wall_s,  # in process they think one after the other
    )


def read(folder: Path, entry: Entry) -> Reading:
    """What a run has left behind. Raises ``OSError`` or ``UsageError`` where that is not all."""
    past = open_run(folder)
    asked_ns = [int(ns) for ns in read_packets(folder, past.ends[_ASKED]).sent_ns]
    figures = interval_figures(intervals_of(asked_ns, THINK_S))
    remarks = {"backend": past.record["backend"]}
    return Reading(entry.title, entry.name, {**figures, **_in_seconds(figures)}, remarks, None)


def _in_seconds(figures: dict[str, float | None]) -> dict[str, float]:
    mean_ms, max_ms = figures.get("mean_ms"), figures.get("max_ms")
    if mean_ms is None or max_ms is None:
        return {}
    return {"mean_s": mean_ms / 1e3, "max_s": max_ms / 1e3, "added_ms": mean_ms - THINK_S * 1e3}


def show(readings: Readings, folder: Path) -> Sequence[Section]:
    """The table."""
    (name,) = PARTS
    figures = {**VOTING, "added_ms": 1e3 * (VOTING["mean_s"] - THINK_S)}
    rows = {**readings, _PUBLISHED: [Reading("", _PUBLISHED, figures, {}, None)]}
    table = LAYOUT.fill({name: f"{PARTS[name]}, here", _PUBLISHED: _PUBLISHED}, rows)
    text = (
        "An interval is the time from one question to the next: the 5 s in which the voters think,"
        " at the same time, and what sending the question, three votes, and waiting for all of"
        " them adds. Published intervals are between lines of the log of the node that asks."
    )
    return [Section("Interval between questions", [text], table)]


KIND = Kind(
    title="Tasks that run at once",
    introduction=(
        "A chair puts a question to three voters and asks the next one when all have voted; each"
        f" voter thinks for {THINK_S:g} s (examples/2_synchronisation/voting with"
        f" THINK_SECONDS={THINK_S:g}). Between processes they think at the same time."
    ),
    parts=PARTS,
    run=run,
    read=read,
    show=show,
    shortest_s=3 * THINK_S,
    duration_s=60.0,
)
