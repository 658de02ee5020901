"""One run of WhiskEye, and what it has come to."""

from __future__ import annotations

import csv
import functools
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.launching import RUN_S, launch
from benchmarks.reproduce.experiment import Entry
from benchmarks.reproduce.intervals import interval_figures
from benchmarks.reproduce.kinds import Reading
from benchmarks.reproduce.packets import (
    after_the_start,
    load_meanwhile,
    packet_figures,
    speed_percent,
)
from benchmarks.subjects.whiskeye import IMU, WHISKEYE
from neuros.api.packets import read_packets
from neuros.api.run_record import open_run

FILES = {
    "tick_20ms": "tick_20ms.json",
    "tick_60ms": "tick_60ms.json",
    "tick_100ms": "tick_100ms.json",
    "strict": "strict.json",
    "no_discard_limit": "no_discard_limit.json",
    "asynchronous": "asynchronous.json",
    "hybrid": "project.json",
}
WITH_1_MS = "_1ms"
"""Behind the name of a part with a tick: it steps 1 ms of physics, as published."""
SHARE_WITH_1_MS = 20
"""Such a part simulates this much less: it takes as long as the others of its tick."""
POSE = "robot.pose -> visualiser.truth"
ESTIMATE = "snn.estimate -> visualiser.estimate"
CONNECTIONS = {IMU: "imu", POSE: "pose", ESTIMATE: "estimate"}
TIMED_HOOK = "simulate"
IMU_PERIOD_S = 0.02
_SLOWEST = 20
"""Wall seconds per simulated one that a run may take before it is given up."""


@dataclass(frozen=True)
class Series:
    """What is drawn of a run.

    Attributes:
        estimates, truths: heading in rad by stamp in ns.
        time_s, error_deg: of the estimates that could be compared, (n,).
        timeline: simulated and wall seconds.
        ticks: intervals of the robot's timer, as in ``run.json``, if it has one.
    """

    estimates: Mapping[int, float]
    truths: Mapping[int, float]
    time_s: Any
    error_deg: Any
    timeline: Sequence[Sequence[float]]
    ticks: Mapping[str, Any] | None


def run(name: str, folder: Path, simulated_s: float, backend: str) -> None:
    """Run one orchestration through the command line."""
    settings = {"nodes.robot.environment.DURATION": simulated_s}
    if name.endswith(WITH_1_MS):
        settings = {
            "nodes.robot.environment.DURATION": simulated_s / SHARE_WITH_1_MS,
            "nodes.robot.environment.STEP_SECONDS": 0.001,
        }
    launch(
        WHISKEYE / FILES[name.removesuffix(WITH_1_MS)],
        folder,
        backend,
        settings=settings,
        options=["-m", "--digests"],
        timeout_s=RUN_S + _SLOWEST * simulated_s,
    )


def read(folder: Path, entry: Entry) -> Reading:
    """What a run has left behind. Raises ``OSError`` or ``UsageError`` where that is not all."""
    past = open_run(folder)
    record = past.record
    heading = heading_error_module()
    estimates, truths = _headings(folder / "visualiser" / "head_direction.csv")
    comparison = heading.compare(estimates, truths)
    error_deg = np.degrees(comparison.error_rad)
    sent_ns = after_the_start(read_packets(folder, past.ends[IMU]).sent_ns)
    ticks = record["nodes"]["robot"]["hooks"].get(TIMED_HOOK, {}).get("ticks")
    figures: dict[str, float | None] = {
        "speed_percent": speed_percent(sent_ns, IMU_PERIOD_S),
        "wall_s": record["wall_s"],
        "simulated_s": record["sim_s"],
        **packet_figures(past, CONNECTIONS),
        **_errors(heading.heading_error(comparison), error_deg),
        **interval_figures(ticks),
        **load_meanwhile(folder, sent_ns, entry.unix_minus_monotonic_s),
    }
    digests = past.connections[ESTIMATE]["digests"]
    remarks = {
        "backend": record["backend"],
        "estimates_digest": digests["sent"][:8] if digests else "",
    }
    series = Series(
        estimates, truths, comparison.time_s, error_deg, record["timeline"].get("robot", ()), ticks
    )
    return Reading(entry.title, entry.name, figures, remarks, series)


@functools.cache
def heading_error_module() -> Any:
    """The example's own arithmetic of heading errors."""
    file = WHISKEYE / "heading_error.py"
    spec = importlib.util.spec_from_file_location("whiskeye_heading_error", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def _headings(file: Path) -> tuple[dict[int, float], dict[int, float]]:
    """Estimates and truths in rad, by stamp in ns."""
    estimates: dict[int, float] = {}
    truths: dict[int, float] = {}
    with file.open(newline="", encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            for series, key in ((estimates, "estimate_rad"), (truths, "truth_rad")):
                if row[key]:
                    series[int(row["stamp_ns"])] = float(row[key])
    return estimates, truths


def _errors(summary: Any, error_deg: Any) -> dict[str, float | None]:
    return {
        "estimates": summary.samples,
        "rms_deg": summary.rms_deg,
        "mean_deg": float(np.mean(error_deg)) if error_deg.size else None,
        "max_deg": summary.max_deg,
        "gain": summary.gain,
    }
