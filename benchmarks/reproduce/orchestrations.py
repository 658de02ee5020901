"""WhiskEye's seven orchestrations in virtual time: what they cost in accuracy, loss and latency.

The robot turns at rates that change every second, and a packet that is lost is lost angle
(``BRIDGE=0``), so that an orchestration that loses packets cannot be as accurate as one that loses
none. All times are declared: those of the published machine, those that were measured on this one,
or a world in real time with a network that takes a given time. The number of a run is its seed.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.launching import RUN_S, launch
from benchmarks.machine import ROOT
from benchmarks.reproduce import published
from benchmarks.reproduce.experiment import Entry
from benchmarks.reproduce.kinds import Kind, Reading, Readings
from benchmarks.reproduce.packets import packet_figures, speed_percent
from benchmarks.reproduce.page import Section
from benchmarks.reproduce.tables import Layout, Ours, Published, Remark
from benchmarks.reproduce.whiskeye_runs import (
    CONNECTIONS,
    ESTIMATE,
    FILES,
    IMU_PERIOD_S,
    POSE,
    heading_error_module,
)
from benchmarks.subjects.whiskeye import IMU, WHISKEYE
from neuros.api.packets import read_packets
from neuros.api.run_record import PastRun, open_run
from neuros.bag import open_bag
from neuros.time import to_nanoseconds

ORCHESTRATIONS = {
    "tick_20ms": "tick 20 ms",
    "tick_60ms": "tick 60 ms",
    "tick_100ms": "tick 100 ms",
    "strict": "strict",
    "no_discard_limit": "no discard limit",
    "asynchronous": "asynchronous",
    "hybrid": "hybrid",
}
PUBLISHED, HERE = "published", "here"
MACHINES = {PUBLISHED: "published machine", HERE: "this machine"}
COMPUTING_MS = (15, 30, 60, 120)
"""Computing times of the network per packet of the IMU, which comes every 20 ms."""
TIMING = Path(__file__).parent / "timing"
"""Timing files of this machine, as ``neuros timing`` has measured them."""
RATE_RAD_S, VARY_S = 2.0, 1.0
NETWORK_S = 0.044
"""Computing time of the published network per packet of the IMU: see ``docs/reproduce.md``."""
PAIRS = 1001
"""Poses that were sent in a published run, and estimates."""
_SLOWEST = 60
_PHYSICS_S = 0.001
"""Per tick, as published."""


@dataclass(frozen=True)
class Law:
    """Seconds that the published plot took for its nth pair of a pose and an estimate.

    They are ``first_s + growth_s * n``: it drew all points again.
    """

    first_s: float
    growth_s: float


def plot_law() -> Law:
    """Fitted to six of the published orchestrations; the seventh, strict, is what it predicts.

    A run of ``PAIRS`` periods of 20 ms at a speed has drawn a share of the pairs, one after the
    other: each took wall time / number on average, ``first_s + growth_s * number / 2``.
    """
    names = [name for name in published_speeds() if name != "strict"]
    drawn = np.array([_drawn(name) for name in names])
    mean_s = np.array([IMU_PERIOD_S * PAIRS / published_speeds()[name] for name in names]) / drawn
    slope, first_s = np.polyfit(drawn, mean_s, 1)
    return Law(float(first_s), 2 * float(slope))


def published_speeds() -> dict[str, float]:
    """Simulated time by wall time, by orchestration."""
    return {name: published.SPEED_PERCENT[_key(name)] / 100 for name in ORCHESTRATIONS}


def published_settings(name: str) -> dict[str, Any]:
    """Durations and other values that make a run as on the published machine."""
    speeds, law = published_speeds(), plot_law()
    last_s = law.first_s + law.growth_s * _drawn(name)
    hook_s = {"uniform": [round(law.first_s / 2, 4), round(last_s / 2, 4)]}  # two hooks for a pair
    settings: dict[str, Any] = {
        "snn.durations": {"integrate": NETWORK_S},
        "visualiser.durations": {"keep_truth": hook_s, "keep_estimate": hook_s},
    }
    step_s = IMU_PERIOD_S / speeds["hybrid" if name == "strict" else name]
    if name == "asynchronous":
        settings["robot.environment.REAL_TIME_FACTOR"] = speeds[name]
    elif name.startswith("tick"):
        step_s = _PHYSICS_S / speeds["no_discard_limit"]
        settings["robot.environment.STEP_SECONDS"] = _PHYSICS_S
    if name != "asynchronous":
        settings["robot.durations"] = {"simulate": round(step_s, 6)}
    return settings


def _key(name: str) -> str:
    return f"{name}_1ms" if name.startswith("tick") else name


def _drawn(name: str) -> float:
    """Pairs that the published plot has drawn."""
    return PAIRS * published.DELIVERY_PERCENT["pose"][_key(name)] / 100


def parts() -> dict[str, str]:
    """Each orchestration on each machine, and with each computing time."""
    machines = {
        f"{name}.{machine}": f"{title}, {MACHINES[machine]}"
        for machine in MACHINES
        for name, title in ORCHESTRATIONS.items()
    }
    return machines | {
        f"{name}.{ms}ms": f"{title}, network {ms} ms"
        for name, title in ORCHESTRATIONS.items()
        for ms in COMPUTING_MS
    }


def run(part: str, folder: Path, simulated_s: float, backend: str) -> None:
    """Run one part in virtual time; in process, unless another back end is named."""
    name, _, how = part.partition(".")
    seed = int(folder.name.rpartition("-")[2])
    settings: dict[str, Any] = {
        "robot.environment.DURATION": simulated_s,
        "robot.environment.RATE": RATE_RAD_S,
        "robot.environment.VARY_SECONDS": VARY_S,
        "robot.environment.SEED": seed,
        "snn.environment.SEED": seed,
        "snn.environment.BRIDGE": 0,
        "visualiser.environment.REDRAW_EVERY_PACKET": 0,
    }
    options = ["--time", "virtual", "--portable", "--digests", "-r"]
    if how == PUBLISHED:
        settings |= published_settings(name)
        if name == "strict":  # the example has room for 50 poses and estimates in its plot
            for ends in ("robot.pose.visualiser.truth", "snn.estimate.visualiser.estimate"):
                options += ["--set", f"connections.{ends}.queue_size=1"]
    elif how == HERE:
        every = "_every_packet" if name.startswith("tick") else ""
        options += ["--timing", str(TIMING / f"whiskeye{every}.json")]
    else:
        settings["snn.durations"] = {"integrate": float(how.removesuffix("ms")) / 1000}
    launch(
        WHISKEYE / FILES[name],
        folder,
        "in-process" if backend == "auto" else backend,
        settings={
            f"nodes.{key}": json.dumps(value) if isinstance(value, dict) else value
            for key, value in settings.items()
        },
        options=options,
        timeout_s=RUN_S + _SLOWEST * simulated_s,
    )


def read(folder: Path, entry: Entry) -> Reading:
    """What a run has left behind. Raises ``OSError`` or ``UsageError`` where that is not all."""
    past = open_run(folder)
    heading = heading_error_module()
    with open_bag(folder) as bag:
        estimates = {to_nanoseconds(each): each.vector.z for each in bag[ESTIMATE]}
        truths = {}
        for pose in bag[POSE]:
            q = pose.pose.orientation
            truths[to_nanoseconds(pose)] = heading.yaw_of(q.x, q.y, q.z, q.w)
    imu_ns, pose_ns, estimate_ns = (
        read_packets(folder, past.ends[name]).sent_ns for name in (IMU, POSE, ESTIMATE)
    )
    error = heading.heading_error(heading.compare(estimates, truths))
    known = known_headings(estimates, estimate_ns, truths, pose_ns)
    known_deg = np.degrees(heading.compare(known, truths).error_rad)
    latency_ms = latencies_ms(estimates, estimate_ns, truths, imu_ns)
    counts = packet_figures(past, CONNECTIONS)
    figures: dict[str, float | None] = {
        "rms_deg": error.rms_deg,
        "max_deg": error.max_deg,
        "known_rms_deg": float(np.sqrt(np.mean(known_deg**2))) if known_deg.size else None,
        "latency_ms": float(np.median(latency_ms)) if latency_ms.size else None,
        "loss_percent": 100 - (counts["consumed_percent.imu"] or 0.0),
        "speed_percent": speed_percent(imu_ns, IMU_PERIOD_S),
        "simulated_s": past.record["sim_s"],
        **counts,
    }
    remarks = {"digest": digest_of(past), "command": command_of(past)}
    return Reading(entry.title, entry.name, figures, remarks, None)


def known_headings(
    estimates: Mapping[int, float], sent_ns: Any, truths: Mapping[int, float], pose_ns: Any
) -> dict[int, float]:
    """By stamp of each pose, the newest estimate that the network had sent by then.

    Args:
        estimates, truths: heading in rad, by stamp in ns.
        sent_ns, pose_ns: when each of them was sent, in their order, (n,).
    """
    values = [estimates[stamp] for stamp in sorted(estimates)]
    newest = np.searchsorted(sent_ns, pose_ns, side="right") - 1
    stamps = sorted(truths)
    return {
        stamp: values[place] for stamp, place in zip(stamps, newest, strict=False) if place >= 0
    }


def latencies_ms(
    estimates: Mapping[int, float], sent_ns: Any, truths: Mapping[int, float], imu_ns: Any
) -> Any:
    """From the packet of the IMU to the estimate of its stamp, of each estimate, (n,).

    A pose leaves with each packet of the IMU, so both have the same stamps.
    """
    of_stamp = dict(zip(sorted(truths), imu_ns, strict=False))
    pairs = zip(sorted(estimates), sent_ns, strict=False)
    return np.array([(at - of_stamp[stamp]) * 1e-6 for stamp, at in pairs if stamp in of_stamp])


def digest_of(past: PastRun) -> str:
    """A digest of all packets that were sent and consumed."""
    every = {name: each["digests"] for name, each in sorted(past.connections.items())}
    return hashlib.sha256(json.dumps(every, sort_keys=True).encode()).hexdigest()[:16]


def command_of(past: PastRun) -> str:
    """The command that makes a run with the same digest, in the folder of the checkout."""
    words = [str(word) for word in past.record["command"][1:]]
    del words[words.index("-o") : words.index("-o") + 2]
    return shlex.join(["neuros", *(word.removeprefix(f"{ROOT}/") for word in words)])


_COLUMNS = [
    Ours("IMU consumed, %", "consumed_percent.imu"),
    Published("published, %", {}),
    Ours("latency, ms", "latency_ms", "{:.0f}"),
    Ours("speed, % of real time", "speed_percent", "{:.2f}"),
    Published("published, %", {}),
    Ours("pose consumed, %", "consumed_percent.pose"),
    Published("published, %", {}),
    Ours("RMS, deg", "rms_deg", "{:.2f}"),
    Ours("RMS at the moment, deg", "known_rms_deg", "{:.2f}"),
    Remark("digests", "digest"),
]
_KNOWN = {1: published.DELIVERY_PERCENT["imu"], 4: published.SPEED_PERCENT} | {
    6: published.DELIVERY_PERCENT["pose"]
}


def _layout(machine: str) -> Layout:
    columns: list[Any] = []
    for place, column in enumerate(_COLUMNS):
        if place not in _KNOWN:
            columns.append(column)
        elif machine == PUBLISHED:
            known = {f"{n}.{PUBLISHED}": _KNOWN[place][_key(n)] for n in ORCHESTRATIONS}
            columns.append(Published("published, %", known))
    return Layout(f"orchestrations_{machine}", columns)


def show(readings: Readings, folder: Path) -> Sequence[Section]:
    """All tables and figures."""
    from benchmarks.reproduce.orchestrations_figures import draw_computing, draw_costs

    sections = []
    text = [
        "RMS is the error of all estimates of the network, at their stamps. RMS at the moment"
        " compares the true heading, whenever the robot sends it, with the newest estimate that"
        " the network has sent by then: so latency counts, too. Latency is the time from a packet"
        " of the IMU to its estimate. Medians and ranges are of the seeds.",
        "tables/runs.csv has the digest of every run, and the command that repeats it.",
    ]
    costs = [draw_costs(readings, folder / "orchestrations.png")]
    for machine, title in MACHINES.items():
        titles = {f"{name}.{machine}": each for name, each in ORCHESTRATIONS.items()}
        table = _layout(machine).fill(titles, readings)
        if table.rows:
            sections.append(Section(f"Times of the {title}", text, table, costs))
            text, costs = [], []
    if any(name.endswith("ms") for name in readings):
        picture = draw_computing(readings, folder / "orchestrations_computing.png")
        sections.append(
            Section(
                "Computing time of the network",
                [
                    "The world runs in real time (20 ms of physics take 20 ms, and the plot takes"
                    " no time); the network takes so many milliseconds for each packet."
                ],
                Layout(
                    "orchestrations_computing",
                    [
                        Ours("IMU consumed, %", "consumed_percent.imu"),
                        Ours("speed, % of real time", "speed_percent"),
                        Ours("RMS, deg", "rms_deg", "{:.2f}"),
                        Ours("RMS at the moment, deg", "known_rms_deg", "{:.2f}"),
                    ],
                ).fill({n: t for n, t in parts().items() if n.endswith("ms")}, readings),
                [picture],
            )
        )
    return sections


KIND = Kind(
    title="WhiskEye's seven orchestrations in virtual time",
    introduction=(
        "The seven orchestrations with declared times, so that each point can be repeated. The"
        f" robot turns at rates between -{RATE_RAD_S:g} and {RATE_RAD_S:g} rad/s that change every"
        f" {VARY_S:g} s, and a packet that is lost is lost angle (BRIDGE=0)."
    ),
    parts=parts(),
    run=run,
    read=read,
    show=show,
    duration_s=10.0,
)
