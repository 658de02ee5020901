"""``neuros reproduce`` on real parts: rclpy, MuJoCo, NEST. No time is judged."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from benchmarks.reproduce.whiskeye import PARTS
from neuros.cli.main import main


def rows(folder: Path) -> dict[str, dict[str, str]]:
    """Every figure, by run."""
    with (folder / "tables/runs.csv").open(newline="") as stream:
        return {row["run"]: row for row in csv.DictReader(stream)}


def test_ticks_of_neuros_and_of_bare_rclpy_are_measured_alike(tmp_path: Path) -> None:
    command = ["reproduce", "tick", "--duration", "0.2", "--backend", "process"]
    assert main([*command, "-o", str(tmp_path)]) == 0
    found = rows(tmp_path)
    assert [*found] == ["neuros-1", "rclpy-1"]
    for row in found.values():
        assert row["intervals"] == "9"
        assert float(row["mean_ms"]) == pytest.approx(20, rel=0.9)
    assert "figures/tick_histogram.png" in (tmp_path / "index.md").read_text()


def test_one_orchestration_comes_out_whole(tmp_path: Path) -> None:
    command = ["reproduce", "whiskeye", "--only", "strict", "--duration", "1"]
    assert main([*command, "--backend", "in-process", "-o", str(tmp_path)]) == 0
    (row,) = rows(tmp_path).values()
    assert row["backend"] == "in-process"
    assert row["sent.imu"] == row["consumed.imu"] == row["estimates"] == "50"
    assert float(row["consumed_percent"]) == 100
    assert float(row["rms_deg"]) < 6
    assert float(row["speed_percent"]) > 0
    assert len(row["estimates_digest"]) == 8


@pytest.mark.acceptance
def test_all_seven_orchestrations_come_out_and_lossless_ones_repeat(tmp_path: Path) -> None:
    command = ["reproduce", "whiskeye", "--duration", "4", "--backend", "process"]
    assert main([*command, "-o", str(tmp_path / "all")]) == 0
    found = rows(tmp_path / "all")
    assert len(found) == len(PARTS)
    assert {row["sent.imu"] for row in found.values()} <= {"199", "200"}  # the clock ends one
    assert float(found["strict-1"]["consumed_percent"]) == 100

    lossless = ["--only", "strict", "hybrid", "--repeat", "2", "-o", str(tmp_path / "again")]
    assert main([*command, *lossless]) == 0
    again = rows(tmp_path / "again")
    assert len(again) == 4
    both = [found["strict-1"], found["hybrid-1"], *again.values()]
    assert len({row["estimates_digest"] for row in both}) == 1
