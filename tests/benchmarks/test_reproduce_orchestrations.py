"""The seven orchestrations in virtual time: declared times, and what is read of a run."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.reproduce import published
from benchmarks.reproduce.orchestrations import (
    ORCHESTRATIONS,
    PAIRS,
    TIMING,
    known_headings,
    latencies_ms,
    parts,
    plot_law,
    published_settings,
)
from benchmarks.reproduce.whiskeye_runs import FILES
from benchmarks.subjects.whiskeye import WHISKEYE
from neuros.api.project import Project

MS = 1_000_000


def test_the_plot_alone_explains_how_slow_the_strict_orchestration_was() -> None:
    """The law is fitted to the other six, which drew 57 to 402 pairs; strict drew 1001."""
    law = plot_law()
    mean_s = law.first_s + law.growth_s * PAIRS / 2
    assert 100 * 0.02 / mean_s == pytest.approx(published.SPEED_PERCENT["strict"], rel=0.03)


@pytest.mark.parametrize("name", ["tick_20ms", "hybrid", "no_discard_limit", "asynchronous"])
def test_the_law_tells_how_many_poses_the_published_plot_took(name: str) -> None:
    settings = published_settings(name)
    low, high = settings["visualiser.durations"]["keep_truth"]["uniform"]
    key = f"{name}_1ms" if name.startswith("tick") else name
    pair_s = low + high  # two hooks, each (low + high) / 2 on average
    percent = 100 * 0.02 / (published.SPEED_PERCENT[key] / 100) / pair_s
    assert percent == pytest.approx(published.DELIVERY_PERCENT["pose"][key], rel=0.07)


@pytest.mark.parametrize("name", ORCHESTRATIONS)
def test_projects_accept_the_times_of_the_published_machine(name: str) -> None:
    settings = {f"nodes.{key}": value for key, value in published_settings(name).items()}
    Project.from_file(WHISKEYE / FILES[name], set=settings)


def test_there_is_a_part_for_each_orchestration_on_each_machine_and_at_each_speed() -> None:
    found = parts()
    assert found["strict.published"] == "strict, published machine"
    assert found["tick_20ms.here"] == "tick 20 ms, this machine"
    assert found["hybrid.30ms"] == "hybrid, network 30 ms"
    assert len({*found.values()}) == len(found) == 7 * 6
    assert {file.name for file in TIMING.iterdir()} == {
        "whiskeye.json",
        "whiskeye_every_packet.json",
    }


def test_what_is_known_at_a_moment_is_the_newest_estimate_that_was_sent() -> None:
    poses = {20: 0.0, 40: 0.1, 60: 0.2, 80: 0.3}
    estimates = {20: 1.0, 60: 2.0}  # that of 40 was lost
    known = known_headings(estimates, np.array([45, 90]), poses, np.array([20, 40, 60, 90]))
    assert known == {60: 1.0, 80: 2.0}
    assert known_headings({}, np.array([]), poses, np.array([20, 40])) == {}


def test_a_latency_is_from_the_packet_of_a_stamp_to_its_estimate() -> None:
    poses = dict.fromkeys((20, 40, 60), 0.0)
    imu_ns = np.array([0, 100 * MS, 200 * MS])
    found = latencies_ms({20: 0.0, 60: 0.0}, np.array([44 * MS, 250 * MS]), poses, imu_ns)
    assert found.tolist() == [44.0, 50.0]
    assert latencies_ms({}, np.array([]), poses, imu_ns).size == 0
