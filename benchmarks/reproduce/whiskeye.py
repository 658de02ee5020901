"""WhiskEye in its seven orchestrations: the tables of the dissertation's chapter 4."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.reproduce import published
from benchmarks.reproduce.intervals import INTERVAL_COLUMNS
from benchmarks.reproduce.kinds import Kind, Reading, Readings
from benchmarks.reproduce.page import Section
from benchmarks.reproduce.published import NRP
from benchmarks.reproduce.tables import Layout, Ours, Published, Remark
from benchmarks.reproduce.whiskeye_runs import CONNECTIONS, SHARE_WITH_1_MS, read, run

PARTS = {
    "tick_20ms": "tick 20 ms",
    "tick_60ms": "tick 60 ms",
    "tick_100ms": "tick 100 ms",
    "tick_20ms_1ms": "tick 20 ms, 1 ms of physics",
    "tick_60ms_1ms": "tick 60 ms, 1 ms of physics",
    "tick_100ms_1ms": "tick 100 ms, 1 ms of physics",
    "strict": "strict",
    "no_discard_limit": "no discard limit",
    "asynchronous": "asynchronous",
    "hybrid": "hybrid",
}
_PUBLISHED = "published, all orchestrations"
_WHOLE = "published, % of the machine"


@dataclass(frozen=True)
class _Topic:
    """A section before anything was measured."""

    title: str
    text: str
    layout: Layout


TOPICS = (
    _Topic(
        "Head direction and its error",
        "Estimate of the network against the true heading, aligned by stamp. Estimates are those"
        " that reached the plot. Runs with the same digest had the same estimates, bit for bit."
        " The published network was another one, and orchestrations differed there by less than"
        " 0.05 degrees RMS.",
        Layout(
            "heading",
            [
                Ours("estimates", "estimates", "{:.0f}"),
                Ours("RMS, deg", "rms_deg", "{:.2f}"),
                Ours("mean, deg", "mean_deg", "{:.2f}"),
                Ours("maximum, deg", "max_deg", "{:.2f}"),
                Ours("gain", "gain", "{:.4f}"),
                Remark("digest of the estimates", "estimates_digest"),
            ],
        ),
    ),
    _Topic(
        "Execution speed",
        "Simulated time in per cent of wall time, over the last nine tenths of a run: in the first"
        " one nodes may still wait for others that are starting. The tick and the"
        " asynchronous orchestrations are held to the clock here (20 ms of physics per tick, and"
        " real time), so that 100, 33, 20 and 100 % are all that they can reach. With 1 ms of"
        " physics per tick, as published, that is 5, 1.67 and 1 %; these runs are"
        f" {SHARE_WITH_1_MS} times shorter in simulated time.",
        Layout(
            "speed",
            [
                Remark("back end", "backend"),
                Ours("simulated, s", "simulated_s"),
                Ours("wall time of the run, s", "wall_s"),
                Ours("speed, % of real time", "speed_percent", "{:.2f}"),
                Published("published, % of real time", published.SPEED_PERCENT),
            ],
            others=[NRP],
        ),
    ),
    _Topic(
        "Delivery rate",
        "Packets that were consumed (a hook has started on them), of those sent. Where nothing"
        " holds the physics back it is faster than the network here, and does not wait for its"
        " start either. In the published runs, in which no IMU packet was lost, it must have been"
        " slower.",
        Layout(
            "delivery",
            [
                Ours("all, %", "consumed_percent"),
                Ours("IMU, %", "consumed_percent.imu"),
                Published("published, %", published.DELIVERY_PERCENT["imu"]),
                Ours("pose, %", "consumed_percent.pose"),
                Published("published, %", published.DELIVERY_PERCENT["pose"]),
                Ours("estimate, %", "consumed_percent.estimate"),
                Published("published, %", published.DELIVERY_PERCENT["estimate"]),
            ],
        ),
    ),
    _Topic(
        "Packet counts",
        "Sent and consumed on " + ", ".join(f"{name} ({key})" for name, key in CONNECTIONS.items()),
        Layout(
            "packets",
            [
                Ours(f"{key} {what}", f"{what}.{key}", "{:.0f}")
                for key in CONNECTIONS.values()
                for what in ("sent", "consumed")
            ],
        ),
    ),
    _Topic(
        "Processor and memory",
        "Means over the last nine tenths of the packets of the IMU, one sample per second. 100 %"
        " are all cores. What the whole machine shows includes whatever else it does. Memory of"
        " nodes is their resident memory, added up: libraries that they share count in each. A run"
        " of less than about two seconds has no sample.",
        Layout(
            "load",
            [
                Ours("nodes, % of the machine", "cpu_nodes_percent", "{:.0f}"),
                Ours("whole machine, %", "cpu_machine_percent", "{:.0f}"),
                Published(_WHOLE, published.CPU_PERCENT),
                Ours("memory of nodes, MB", "memory_nodes_MB", "{:.0f}"),
                Ours("used on the machine, MB", "memory_machine_MB", "{:.0f}"),
                Ours("samples", "load_samples", "{:.0f}"),
            ],
            others=[NRP],
        ),
    ),
    _Topic(
        "Tick interval",
        "Times between two starts of the robot's timed hook. What was published about ticks was"
        " measured in an experiment of its own: neuros reproduce tick.",
        Layout("tick_intervals", [Ours("period, ms", "period_ms", "{:g}"), *INTERVAL_COLUMNS]),
    ),
)


def show(readings: Readings, folder: Path) -> Sequence[Section]:
    """All tables and figures."""
    from benchmarks.reproduce.whiskeye_figures import draw

    titles = {name: title for name, title in PARTS.items() if name in readings}
    pictures = draw(titles, readings, folder)
    sections = []
    for topic in TOPICS:
        name = topic.layout.name
        shown, rows = dict(titles), dict(readings)
        if name == "heading":
            shown[_PUBLISHED] = _PUBLISHED
            rows[_PUBLISHED] = [Reading("", _PUBLISHED, published.HEADING, {}, None)]
        if name == "tick_intervals":
            shown = {key: title for key, title in titles.items() if key.startswith("tick")}
        table = topic.layout.fill(shown, rows)
        if table.rows:
            sections.append(Section(topic.title, [topic.text], table, pictures.get(name, ())))
    return sections


KIND = Kind(
    title="WhiskEye in its seven orchestrations",
    introduction=(
        "A simulated robot turns on the spot at 1 rad/s; a spiking network keeps track of its"
        " heading from the gyroscope alone, and a plot shows both. Seven project files connect the"
        " same nodes in seven ways (examples/4_neurorobotics/whiskeye)."
    ),
    parts=PARTS,
    run=run,
    read=read,
    show=show,
)
