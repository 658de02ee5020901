"""WhiskEye in its seven orchestrations against the same experiment in one loop without NeuROS.

``floor.py`` of the example: same model, network and figure, redrawn as often. In one process
NeuROS can only lose against it. Between processes physics and network overlap; the most that can
be gained by that, (physics + network) / network, comes from the parts that the floor measures.
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.launching import launch
from benchmarks.machine import ROOT
from benchmarks.measure import MINIMUM_PAIRS, Case, Figure, Group, Measurement, Subject

WHISKEYE = ROOT / "examples" / "4_neurorobotics" / "whiskeye"
FLOOR = "one loop"
IMU = "robot.imu -> snn.imu"
RATE, OWN_RATE, PACKETS = "real_time_factor", "own_real_time_factor", "imu_per_s"
SIMULATED_S = 10.0
FREE_SIMULATED_S = 45.0  # three seconds when the physics waits for nobody, nor for the start
SLICES = 2  # there and back within a round: a shared machine changes its pace within a minute
ROUNDS_OF_OTHERS = 3
FLOOR_TIMEOUT_S = 120.0
# The others of the seven: what they are made for is not speed. A few seconds of wall time each.
OTHERS = {
    "asynchronous": 4.0,
    "tick_20ms": 4.0,
    "tick_60ms": 1.4,
    "tick_100ms": 0.8,
}


def subject(is_quick: bool) -> Subject:
    """Simulated seconds per run."""
    share = 0.1 if is_quick else 1.0
    return Subject(
        "WhiskEye in its seven orchestrations against one loop without NeuROS",
        (_against_the_floor(share), _others(share)),
    )


def _against_the_floor(share: float) -> Group:
    simulated_s = share * SIMULATED_S
    candidates: dict[str, Measurement] = {
        FLOOR: functools.partial(floor, simulated_s),
        "strict, process": functools.partial(orchestrated, "strict", "process", simulated_s),
        "strict, in process": functools.partial(orchestrated, "strict", "in-process", simulated_s),
        "hybrid, process": functools.partial(orchestrated, "project", "process", simulated_s),
        "hybrid, in process": functools.partial(orchestrated, "project", "in-process", simulated_s),
        "no discard limit, process": functools.partial(
            orchestrated, "no_discard_limit", "process", share * FREE_SIMULATED_S
        ),
    }
    bounds = {
        "strict, process": "whiskeye-strict-process",
        "strict, in process": "whiskeye-strict-in-process",
        "hybrid, process": "whiskeye-hybrid",
        "hybrid, in process": None,
    }
    speed = [
        Case(
            f"whiskeye {name}, real-time factor",
            "",
            Figure(name, RATE),
            Figure(FLOOR, RATE),
            FLOOR,
            bound,
        )
        for name, bound in bounds.items()
    ]
    overlapping = [
        Case(
            f"whiskeye strict, process, against the {what}",
            "",
            Figure("strict, process", RATE),
            Figure(FLOOR, figure),
            what,
            bound,
        )
        for what, figure, bound in (
            ("overlap bound", "overlapped", "whiskeye-strict-process-overlap"),
        )
    ]
    bound_itself = Case("whiskeye, overlap bound of the floor", "", Figure(FLOOR, "overlap_bound"))
    packets = Case(
        "whiskeye no discard limit, process, IMU packets consumed per second",
        "1/s",
        Figure("no discard limit, process", PACKETS),
        Figure("strict, process", PACKETS),
        "strict, process",
        "whiskeye-no-discard-limit",
    )
    return Group(candidates, (*speed, *overlapping, bound_itself, packets), MINIMUM_PAIRS, SLICES)


def _others(share: float) -> Group:
    candidates = {
        f"{name}, {label}": functools.partial(orchestrated, name, backend, share * simulated_s)
        for name, simulated_s in OTHERS.items()
        for backend, label in (("process", "process"), ("in-process", "in process"))
    }
    cases = tuple(
        Case(f"whiskeye {name}, real-time factor of the robot", "", Figure(name, OWN_RATE))
        for name in candidates
    )
    return Group(candidates, cases, ROUNDS_OF_OTHERS)


def floor(simulated_s: float) -> dict[str, float]:
    """The loop without NeuROS: how fast it is, and how fast if physics and network overlapped."""
    threads = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    output = subprocess.run(
        [sys.executable, "floor.py", "--duration", str(simulated_s)],
        cwd=WHISKEYE,
        env={**os.environ, "NEUROS_GUI": "0", **threads},
        check=True,
        text=True,
        capture_output=True,
        timeout=FLOOR_TIMEOUT_S,
    ).stdout
    figures: dict[str, float] = json.loads(output.splitlines()[-1])
    figures["overlapped"] = figures[RATE] * figures["overlap_bound"]
    return {name: figures[name] for name in (RATE, "overlap_bound", "overlapped")}


def orchestrated(name: str, backend: str, simulated_s: float) -> dict[str, float]:
    """A project file of the example, without initialisation and ending."""
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as folder:
        run = launch(
            WHISKEYE / f"{name}.json",
            Path(folder) / "run",
            backend,
            settings={"nodes.robot.environment.DURATION": simulated_s},
        )
    return {
        RATE: float(run[RATE]),
        OWN_RATE: run["sim_s"] / _running_s(run["nodes"]["robot"]["accounting"]),
        PACKETS: _consumed(run) / run["running_s"],
    }


def _running_s(spent: dict[str, Any]) -> float:
    """How long a node ran; where it waits for nobody, it begins before the others are ready."""
    return float(spent["total"] - spent["registering"])


def _consumed(run: dict[str, Any]) -> int:
    counters = {each["connection"]: each for each in run["connections"]}
    return int(counters[IMU]["consumed"])
