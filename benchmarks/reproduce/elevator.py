"""How fast a simulation is beside its controller: the example ``elevator`` in its three forms."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.launching import RUN_S, launch
from benchmarks.machine import ROOT
from benchmarks.reproduce import published
from benchmarks.reproduce.experiment import Entry
from benchmarks.reproduce.kinds import Kind, Reading, Readings
from benchmarks.reproduce.packets import (
    after_the_start,
    load_meanwhile,
    packet_figures,
    speed_percent,
)
from benchmarks.reproduce.page import Section
from benchmarks.reproduce.tables import Layout, Ours, Published, Remark
from neuros.api.packets import read_packets
from neuros.api.run_record import open_run

FOLDER = ROOT / "examples" / "3_physics_simulation" / "elevator"
FILES = {
    "strict": "project.json",
    "no_discard_limit": "no_discard_limit.json",
    "asynchronous": "asynchronous.json",
}
PARTS = {
    "strict": "strict",
    "no_discard_limit": "no discard limit",
    "asynchronous": "asynchronous",
}
CONNECTIONS = {
    "elevator.cabin -> controller.cabin": "cabin",
    "controller.target -> elevator.target": "target",
}
CABIN_PERIOD_S = 0.05
_TOUR = "2 1 3 0 " * 10_000  # longer than any run
LAYOUT = Layout(
    "elevator",
    [
        Remark("back end", "backend"),
        Ours("speed, % of real time", "speed_percent"),
        Published("published, %", published.ELEVATOR_SPEED_PERCENT),
        Ours("readings consumed, %", "consumed_percent.cabin"),
        Ours("commands consumed, %", "consumed_percent.target"),
        Ours("nodes, % of the machine", "cpu_nodes_percent", "{:.0f}"),
        Ours("whole machine, %", "cpu_machine_percent", "{:.0f}"),
        Published("published, %", published.ELEVATOR_CPU_PERCENT),
    ],
)
_TEXT = (
    "Simulated time in per cent of wall time, over the last nine tenths of the readings; packets"
    " that a hook has started on, of those sent; processor load meanwhile, 100 % are all cores. In"
    " the published runs nothing was lost between nodes, and the whole machine was measured. One"
    " execution of the physics is one step of Gazebo there, and 50 ms of MuJoCo here. The"
    " asynchronous simulation is held to real time."
)


def run(name: str, folder: Path, wall_s: float, backend: str) -> None:
    """Let the cabin go from level to level for so long."""
    launch(
        FOLDER / FILES[name],
        folder,
        backend,
        settings={"nodes.controller.environment.TOUR": _TOUR},
        options=["-m", "--digests", "--duration", str(wall_s)],
        timeout_s=RUN_S + 2 * wall_s,
    )


def read(folder: Path, entry: Entry) -> Reading:
    """What a run has left behind. Raises ``OSError`` or ``UsageError`` where that is not all."""
    past = open_run(folder)
    name = next(iter(CONNECTIONS))
    sent_ns = after_the_start(read_packets(folder, past.ends[name]).sent_ns)
    figures: dict[str, float | None] = {
        "speed_percent": speed_percent(sent_ns, CABIN_PERIOD_S),
        "wall_s": past.record["wall_s"],
        **packet_figures(past, CONNECTIONS),
        **load_meanwhile(folder, sent_ns, entry.unix_minus_monotonic_s),
    }
    return Reading(entry.title, entry.name, figures, {"backend": past.record["backend"]}, None)


def show(readings: Readings, folder: Path) -> Sequence[Section]:
    """The table."""
    return [Section("Speed, packets and processor", [_TEXT], LAYOUT.fill(PARTS, readings))]


KIND = Kind(
    title="A simulation and its controller",
    introduction=(
        "A simulated elevator sends readings, and a controller answers each with the level to go"
        " to. Three project files connect the same nodes in three ways"
        " (examples/3_physics_simulation/elevator)."
    ),
    parts=PARTS,
    run=run,
    read=read,
    show=show,
    shortest_s=1.0,
)
