"""The figures of reproduced experiments, from files that a run leaves."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.reproduce import whiskeye_runs
from benchmarks.reproduce.experiment import Entry
from benchmarks.reproduce.intervals import histogram, interval_figures, intervals_of
from benchmarks.reproduce.kinds import Reading
from benchmarks.reproduce.load import load_between
from neuros.api.run_record import FORMAT

MS = 1_000_000


# ------------------------------------------------------------------ intervals


def test_intervals_are_counted_as_those_of_hooks_are() -> None:
    ticks = intervals_of([0, 20 * MS, 41 * MS, 60 * MS, 83 * MS], 0.02)
    assert ticks is not None
    figures = interval_figures(ticks)
    assert figures["intervals"] == 4
    assert figures["mean_ms"] == pytest.approx(20.75)
    assert figures["within_1ms_percent"] == pytest.approx(75)
    assert figures["within_5ms_percent"] == pytest.approx(100)
    bins, percents = histogram([ticks, ticks])
    assert bins == [19.0, 20.0, 21.0, 23.0]
    assert percents == [25.0] * 4


def test_one_moment_has_no_interval() -> None:
    assert intervals_of([0], 0.02) is None
    assert interval_figures(None) == {}


# ------------------------------------------------------------------ system load

LOAD = """\
time_s,unix_time_s,core0_percent,core1_percent,memory_used_bytes,robot.cpu_percent,\
robot.memory_bytes,robot.threads,snn.cpu_percent,snn.memory_bytes,snn.threads,\
launcher.cpu_percent,launcher.memory_bytes,launcher.threads
1.0,101.0,100.0,100.0,9000000,100.0,9000000,2,,,,5.0,7000000,3
2.0,102.0,50.0,30.0,2000000,20.0,3000000,2,60.0,5000000,4,5.0,7000000,3
3.0,103.0,30.0,10.0,4000000,40.0,5000000,2,,,,5.0,7000000,3
4.0,104.0,100.0,100.0,9000000,100.0,9000000,2,,,,5.0,7000000,3
"""


def test_only_what_lies_between_two_moments_counts(tmp_path: Path) -> None:
    (tmp_path / "system_load.csv").write_text(LOAD)
    assert load_between(tmp_path, 101.0, 103.5) == {
        "load_samples": 2,
        "cpu_machine_percent": 30.0,
        "cpu_nodes_percent": 30.0,
        "cpu_percent.robot": 15.0,
        "cpu_percent.snn": 15.0,
        "memory_machine_MB": 3.0,
        "memory_nodes_MB": 6.5,
        "memory_MB.robot": 4.0,
        "memory_MB.snn": 2.5,
    }


def test_a_run_shorter_than_a_sample_has_no_load(tmp_path: Path) -> None:
    (tmp_path / "system_load.csv").write_text(LOAD)
    assert load_between(tmp_path, 101.2, 102.9) == {}
    (tmp_path / "system_load.csv").write_text(LOAD.splitlines()[0])
    assert load_between(tmp_path, 0, 1e12) == {}


# ------------------------------------------------------------------ WhiskEye

CONNECTIONS = {  # sent, consumed
    "robot.imu -> snn.imu": (100, 100),
    "robot.pose -> visualiser.truth": (100, 50),
    "snn.estimate -> visualiser.estimate": (100, 60),
}


def connection(index: int, name: str) -> dict[str, Any]:
    sent, consumed = CONNECTIONS[name]
    return {
        "connection": name,
        "index": index,
        "discard_limit": None,
        "queue_size": 1,
        "sent": sent,
        "received": sent,
        "consumed": consumed,
        "digests": {"sent": "0123456789abcdef"},
    }


def whiskeye_run(folder: Path) -> Path:
    """100 packets of the IMU: the first ten wait for a second each, the others come every 10 ms."""
    ticks = intervals_of([0, 20 * MS, 40 * MS], 0.02)
    hooks = {"start": {"executions": 1}, "simulate": {"executions": 100, "ticks": ticks}}
    record = {
        "format": FORMAT,
        "backend": "process",
        "sim_s": 2.0,
        "wall_s": 12.5,
        "timeline": {"robot": [[0.0, 1.0], [1.0, 11.5], [2.0, 12.0]]},
        "connections": [connection(i, name) for i, name in enumerate(CONNECTIONS)],
        "nodes": {"robot": {"hooks": hooks}},
    }
    (folder / "visualiser").mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(record))
    rows = ["stamp_ns,estimate_rad,truth_rad"]
    for number in range(1, 101):
        truth = math.remainder(number * 0.1, math.tau)
        estimate = repr(math.remainder(truth + math.radians(3), math.tau)) if number % 2 else ""
        rows.append(f"{number * 20 * MS},{estimate},{truth!r}")
    (folder / "visualiser/head_direction.csv").write_text("\n".join(rows) + "\n")
    (folder / "robot/packets").mkdir(parents=True)
    waits_s = [1.0] * 10 + [0.01] * 90
    sent_ns = (np.cumsum(waits_s) * 1e9).astype(np.int64)
    sent_ns.tofile(folder / "robot/packets/0.sent_ns")
    (folder / "system_load.csv").write_text(LOAD)
    return folder


@pytest.fixture
def read(tmp_path: Path) -> Reading:
    """A run in which the last nine tenths were sent from Unix time 100.91 to 101.8."""
    return whiskeye_runs.read(whiskeye_run(tmp_path / "run"), Entry("tick_20ms", 1, 0.0, 90.9))


def test_the_speed_is_that_after_the_start(read: Reading) -> None:
    assert read.figures["speed_percent"] == pytest.approx(200)


def test_the_load_is_that_of_the_same_time(tmp_path: Path) -> None:
    folder = whiskeye_run(tmp_path)
    sent_ns = np.array([0, *np.linspace(11.0e9, 13.0e9, 9)], dtype=np.int64)
    sent_ns.tofile(folder / "robot/packets/0.sent_ns")
    found = whiskeye_runs.read(folder, Entry("strict", 1, 0.0, 90.0))
    assert found.figures["load_samples"] == 2
    assert found.figures["cpu_machine_percent"] == 30.0


def test_packets_and_errors_are_read(read: Reading) -> None:
    expected = {
        "consumed_percent": 70.0,
        "consumed_percent.imu": 100.0,
        "consumed_percent.pose": 50.0,
        "sent.estimate": 100,
        "consumed.estimate": 60,
        "estimates": 50,
        "rms_deg": 3.0,
        "mean_deg": 3.0,
        "max_deg": 3.0,
        "gain": 1.0,
        "std_ms": 0.0,
        "wall_s": 12.5,
    }
    assert {key: read.figures[key] for key in expected} == pytest.approx(expected)
    assert read.remarks == {"backend": "process", "estimates_digest": "01234567"}
