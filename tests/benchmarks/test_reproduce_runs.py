"""``neuros reproduce`` on real parts: rclpy, MuJoCo, NEST. No time is judged."""

from __future__ import annotations

import csv
import os
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from benchmarks.machine import ROOT
from benchmarks.reproduce import orchestrations, voting
from benchmarks.reproduce.experiment import Entry
from benchmarks.reproduce.whiskeye import PARTS
from neuros.api.run_record import open_run
from neuros.cli.main import main


def rows(folder: Path) -> dict[str, dict[str, str]]:
    """Every figure, by run."""
    with (folder / "tables/runs.csv").open(newline="") as stream:
        return {row["run"]: row for row in csv.DictReader(stream)}


@pytest.mark.acceptance
def test_ticks_of_neuros_and_of_bare_rclpy_are_measured_alike(tmp_path: Path) -> None:
    command = ["reproduce", "tick", "--duration", "3", "--backend", "process"]
    assert main([*command, "-o", str(tmp_path)]) == 0
    found = rows(tmp_path)
    assert [*found] == ["neuros-1", "rclpy-1"]
    for row in found.values():
        assert row["intervals"] == "2"
        assert float(row["mean_ms"]) == pytest.approx(1000, rel=0.5)
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
def test_a_tick_of_1_ms_of_physics_simulates_a_twentieth_of_the_time(tmp_path: Path) -> None:
    command = ["reproduce", "whiskeye", "--only", "tick_20ms_1ms", "--duration", "2"]
    assert main([*command, "--backend", "in-process", "-o", str(tmp_path)]) == 0
    (row,) = rows(tmp_path).values()
    assert float(row["simulated_s"]) == pytest.approx(0.1)
    assert row["sent.imu"] == "5"
    assert float(row["intervals"]) > 50, "a tick per millisecond, less those that coalesced"


@pytest.mark.acceptance
def test_the_elevator_goes_on_for_as_long_as_it_is_measured(tmp_path: Path) -> None:
    command = ["reproduce", "elevator", "--duration", "1", "--backend", "in-process"]
    assert main([*command, "-o", str(tmp_path)]) == 0
    found = rows(tmp_path)
    assert [*found] == ["strict-1", "no_discard_limit-1", "asynchronous-1"]
    assert all(float(row["speed_percent"]) > 0 for row in found.values())
    assert float(found["strict-1"]["consumed_percent"]) > 99, "one may be under way at the end"
    assert "| strict" in (tmp_path / "index.md").read_text()


@pytest.mark.acceptance
def test_voters_think_at_the_same_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voting, "THINK_S", 0.25)
    voting.run("voting", tmp_path / "run", 1.0, "process")
    reading = voting.read(tmp_path / "run", Entry("voting", 1, 0.0, 0.0))
    assert reading.figures["intervals"] == 3
    added_ms = reading.figures["added_ms"]
    assert added_ms is not None
    assert added_ms > 0
    (section,) = voting.show({"voting": [reading]}, tmp_path)
    assert section.table is not None
    assert [row[0] for row in section.table.rows] == [
        "three voters, here",
        "three voters, published",
    ]


@pytest.mark.acceptance
def test_all_seven_orchestrations_come_out_and_lossless_ones_repeat(tmp_path: Path) -> None:
    command = ["reproduce", "whiskeye", "--duration", "4", "--backend", "process"]
    assert main([*command, "-o", str(tmp_path / "all")]) == 0
    found = rows(tmp_path / "all")
    assert len(found) == len(PARTS)
    whole = {name: row["sent.imu"] for name, row in found.items() if "_1ms" not in name}
    assert set(whole.values()) <= {"199", "200"}  # the clock ends one
    assert float(found["strict-1"]["consumed_percent"]) == 100

    lossless = ["--only", "strict", "hybrid", "--repeat", "2", "-o", str(tmp_path / "again")]
    assert main([*command, *lossless]) == 0
    again = rows(tmp_path / "again")
    assert len(again) == 4
    both = [found["strict-1"], found["hybrid-1"], *again.values()]
    assert len({row["estimates_digest"] for row in both}) == 1


@pytest.mark.acceptance
@pytest.mark.needs("OpenGL")
def test_a_network_is_trained_and_its_weights_correct_the_ring(tmp_path: Path) -> None:
    command = ["reproduce", "headdirection", "--duration", "1.5", "--backend", "process"]
    parts = ["--only", "training", "left_biased"]
    assert main([*command, *parts, "-o", str(tmp_path)]) == 0
    found = rows(tmp_path)
    assert [*found] == ["training-1", "left_biased-1"]
    assert 20 < float(found["training-1"]["learnt"]) < 60
    biased = found["left_biased-1"]
    assert float(biased["simulated_s"]) == pytest.approx(1.5)
    assert float(biased["uncorrected_samples"]) == 75
    assert float(biased["vision_samples"]) == 15
    assert float(biased["uncorrected_max_deg"]) > 4, "a bias of 0.1 rad/s makes 8.6 degrees"
    page = (tmp_path / "index.md").read_text()
    assert "figures/correction_error.png" in page
    assert "Some runs here were shorter" in page


def test_an_orchestration_in_virtual_time_has_a_digest_that_its_command_repeats(
    tmp_path: Path,
) -> None:
    parts = ("strict.60ms", "no_discard_limit.60ms")
    command = ["reproduce", "orchestrations", "--duration", "2", "--backend", "in-process"]
    assert main([*command, "--only", *parts, "-o", str(tmp_path / "first")]) == 0
    strict, free = rows(tmp_path / "first").values()
    assert float(strict["loss_percent"]) == 0
    assert float(free["loss_percent"]) > 50
    assert float(strict["rms_deg"]) < 6 < float(free["rms_deg"]), "a lost packet is lost angle"
    assert float(strict["speed_percent"]) == pytest.approx(100 / 3, rel=0.05)
    assert float(free["speed_percent"]) == pytest.approx(100, rel=0.01)
    for picture in ("orchestrations", "orchestrations_computing"):
        assert (tmp_path / f"first/figures/{picture}.png").stat().st_size > 10_000

    assert repeated(free["command"], tmp_path / "again") == free["digest"]


def repeated(command: str, folder: Path) -> str:
    """The digest of a run by a command of the table."""
    program, *words = shlex.split(command)
    assert program == "neuros"
    again = subprocess.run(
        [sys.executable, "-m", "neuros.cli", *words, "-o", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert again.returncode == 0, again.stderr
    return orchestrations.digest_of(open_run(folder))


@pytest.mark.acceptance
@pytest.mark.parametrize("run", ["no_discard_limit.30ms-1", "asynchronous.here-2"])
def test_the_points_of_the_documentation_can_be_repeated(run: str, tmp_path: Path) -> None:
    libraries = {name: metadata.version(name) for name in ("mujoco", "nest-simulator", "numpy")}
    libraries["glibc"] = (os.confstr("CS_GNU_LIBC_VERSION") or "").removeprefix("glibc ")
    page = (ROOT / "docs/reproduce.md").read_text()
    if any(f"{name} {version}" not in page for name, version in libraries.items()):
        pytest.skip(f"the page is of other libraries than {libraries}")
    with (ROOT / "docs/figures/reproduce_orchestrations.csv").open(newline="") as stream:
        (row,) = (row for row in csv.DictReader(stream) if row["run"] == run)
    assert repeated(row["command"], tmp_path / "run") == row["digest"]
