"""The figures of the WhiskEye experiment: 20 simulated seconds at a time, through the launcher.

Ten minutes or so, half of which are the ticks: ``pytest -m acceptance -rP tests/acceptance``; -rP
shows the tables of the variants.
"""

from __future__ import annotations

import csv
import importlib.util
import json
import sys
from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest
from launching import BACKENDS, EXAMPLES, Finished, launch

pytestmark = pytest.mark.acceptance

WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
SECONDS, PACKETS = 20, 1000
TIMEOUT_S = 240.0
IMU = "robot.imu -> snn.imu"
TRUTH = "robot.pose -> visualiser.truth"
ESTIMATE = "snn.estimate -> visualiser.estimate"
SEEDS = (1, 2, 3)


class Experiment:
    """One finished run, and what its files say."""

    def __init__(self, run: Finished) -> None:
        assert run.exit_code == 0, run.output
        assert run.run_folder is not None
        self.run, self.folder = run, run.run_folder / "visualiser"
        self.error = json.loads((self.folder / "head_direction.json").read_text())
        self.csv = (self.folder / "head_direction.csv").read_bytes()
        rows = list(csv.DictReader(self.csv.decode().splitlines()))
        self.estimates = {row["stamp_ns"]: row["estimate_rad"] for row in rows}
        self.truths = {int(r["stamp_ns"]): float(r["truth_rad"]) for r in rows if r["truth_rad"]}

    def counts(self, connection: str) -> tuple[int, ...]:
        found = self.run.connection(connection)
        return tuple(found[key] for key in ("sent", "received", "consumed", "discarded", "lost"))

    def share_lost_to_the_plot(self) -> float:
        """Of the packets for the visualiser, those that it has not consumed."""
        both = [self.run.connection(name) for name in (TRUTH, ESTIMATE)]
        return 1 - sum(c["consumed"] for c in both) / sum(c["sent"] for c in both)

    def assert_within(self, rms_deg: float, max_deg: float | None, gain: float) -> None:
        assert self.error["rms_deg"] <= rms_deg
        assert max_deg is None or self.error["max_deg"] <= max_deg
        assert self.error["gain"] == pytest.approx(1.0, abs=gain)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory) -> Callable[..., Experiment]:
    """Run a variant with settings like ``robot_RATE="-1"``; each only once, unless ``again``."""
    done: dict[object, Experiment] = {}

    def run(variant: str, backend: str = "process", again: int = 0, **settings: str) -> Experiment:
        key = (variant, backend, again, *sorted(settings.items()))
        if key not in done:
            arguments = ["--backend", backend]
            for name, value in settings.items():
                node, _, variable = name.partition("_")
                arguments += ["--set", f"nodes.{node}.environment.{variable}={value}"]
            options = {"cwd": tmp_path_factory.mktemp(variant), "timeout_s": TIMEOUT_S}
            project = WHISKEYE / f"{variant}.json"
            done[key] = Experiment(launch(project, *arguments, NEUROS_GUI="0", **options))
        return done[key]

    return run


@pytest.fixture(scope="module")
def compare() -> ModuleType:
    """The example's own ``compare.py``."""
    spec = importlib.util.spec_from_file_location("whiskeye_compare", WHISKEYE / "compare.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# ------------------------------------------------------------------ the published rows


@pytest.mark.parametrize("rate", ["1.0", "-1.0"])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_hybrid_tracks_a_turn_both_ways_and_loses_no_imu_packet(experiment, seed, rate):
    found = experiment("project", robot_RATE=rate, snn_SEED=str(seed))
    assert found.counts(IMU) == (PACKETS, PACKETS, PACKETS, 0, 0)
    assert found.counts(TRUTH)[0] == PACKETS
    assert found.run.record["sim_s"] == pytest.approx(SECONDS)
    found.assert_within(rms_deg=5, max_deg=12, gain=0.01)
    picture = (found.folder / "head_direction.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > 20_000


@pytest.mark.parametrize("sign", [1, -1])
def test_the_robot_turns_as_it_is_told(experiment, sign):
    truths = experiment("strict", robot_RATE=f"{sign}.0").truths
    time_s = np.array(sorted(truths)) * 1e-9
    yaw_rad = np.unwrap([truths[stamp] for stamp in sorted(truths)])
    rate = np.polyfit(time_s, yaw_rad, 1)[0]
    assert rate == pytest.approx(sign, abs=0.002)
    assert yaw_rad[-1] == pytest.approx(sign * SECONDS, abs=np.radians(0.5))


@pytest.mark.parametrize("sign", [1, -1])
def test_the_estimate_turns_the_same_way(experiment, sign):
    values = [
        float(each) for each in experiment("strict", robot_RATE=f"{sign}.0").estimates.values()
    ]
    assert sign * (np.unwrap(values)[-1] - values[0]) == pytest.approx(SECONDS, abs=0.3)


@pytest.mark.parametrize(("rate", "rms_deg", "gain"), [("0.5", 7, 0.025), ("2.0", 10, 0.02)])
@pytest.mark.parametrize("seed", SEEDS)
def test_other_rates(experiment, rate, rms_deg, gain, seed):
    found = experiment("strict", robot_RATE=rate, snn_SEED=str(seed))
    found.assert_within(rms_deg, None, gain)


@pytest.mark.parametrize("seed", SEEDS)
def test_standing_still_it_does_not_drift(experiment, seed):
    found = experiment("strict", robot_RATE="0.0", snn_SEED=str(seed))
    assert abs(found.error["drift_deg_s"]) <= 0.05


def test_a_biased_gyroscope_leads_it_astray(experiment):
    """It shows that the other rows could fail."""
    found = experiment("strict", snn_GYRO_BIAS="0.1")
    assert found.error["rms_deg"] > 50
    assert 95 <= found.error["max_deg"] <= 130


def test_the_network_is_at_least_twice_as_fast_as_real_time(experiment):
    found = experiment("strict", robot_RATE="1.0")
    busy_s = found.run.record["nodes"]["snn"]["accounting"]["executing"]["integrate"]
    assert SECONDS / busy_s >= 2


# ------------------------------------------------------------------ reproducibility


def test_the_strict_variant_gives_the_same_bits_in_five_runs_on_both_back_ends(experiment):
    found = [
        experiment("strict", backend, again=run) for backend in BACKENDS for run in range(1, 6)
    ]
    for each in found:
        for connection in (IMU, TRUTH, ESTIMATE):
            assert each.counts(connection) == (PACKETS, PACKETS, PACKETS, 0, 0)
    assert len({each.csv for each in found}) == 1


def test_the_hybrid_has_the_estimates_of_the_strict_variant(experiment):
    strict = experiment("strict", robot_RATE="1.0").estimates
    hybrid = experiment("project", robot_RATE="1.0", snn_SEED="1").estimates
    seen = {stamp: value for stamp, value in hybrid.items() if value}
    assert len(seen) > PACKETS / 4
    assert seen.items() <= strict.items()


# ------------------------------------------------------------------ the variants


VARIANTS = {
    "project": {},
    "strict": {},
    "no_discard_limit": {},
    "asynchronous": {},
    "asynchronous max": {"robot_REAL_TIME_FACTOR": "max"},
    "tick_20ms": {},
    "tick_60ms": {},
    "tick_100ms": {},
}


def test_the_variants_side_by_side(experiment, compare):
    runs = {name: experiment(name.split()[0], **settings) for name, settings in VARIANTS.items()}
    rows = {name: compare.read_run(found.folder.parent) for name, found in runs.items()}
    print(compare.table(list(rows.values())))
    for name, row in rows.items():
        assert row.physics > 0, name
        assert 0 < row.imu <= 1, name
        assert row.rms_deg is not None, name
    for lossless in ("project", "strict"):
        assert rows[lossless].imu == 1
    assert rows["asynchronous"].physics == pytest.approx(1.0, abs=0.1)
    for name, factor in (("tick_20ms", 1.0), ("tick_60ms", 1 / 3), ("tick_100ms", 0.2)):
        assert rows[name].physics == pytest.approx(factor, rel=0.1)


def test_a_shorter_tick_is_faster_and_costs_the_slow_plot_more(experiment):
    ticks = [experiment(name) for name in ("tick_20ms", "tick_60ms", "tick_100ms")]
    factors = [tick.run.record["real_time_factor"] for tick in ticks]
    assert factors == sorted(factors, reverse=True)
    lost = [tick.share_lost_to_the_plot() for tick in ticks]
    assert lost == sorted(lost, reverse=True)
    assert lost[0] > lost[-1]


def test_in_process_the_variants_end_properly_too(experiment, compare):
    names = [name for name in VARIANTS if not name.startswith("tick_") or name == "tick_20ms"]
    runs = [experiment(name.split()[0], "in-process", **VARIANTS[name]) for name in names]
    print(compare.table([compare.read_run(found.folder.parent) for found in runs]))
    for found in runs:
        assert found.run.record["sim_s"] >= SECONDS - 1e-6
        assert found.counts(IMU)[2] > 0
