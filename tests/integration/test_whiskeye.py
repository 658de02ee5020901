"""WhiskEye as a user launches it, for two simulated seconds; the long rows are in acceptance."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from launching import BACKENDS, EXAMPLES, Finished, launch

for needed in ("mujoco", "nest", "matplotlib"):
    pytest.importorskip(needed)

WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
SECONDS = 2
PACKETS = SECONDS * 50
TIMEOUT_S = 60.0

IMU = "robot.imu -> snn.imu"
TRUTH = "robot.pose -> visualiser.truth"
ESTIMATE = "snn.estimate -> visualiser.estimate"


def whiskeye(variant: str, backend: str, cwd: Path, *settings: str) -> Finished:
    """Run a variant to its end, without windows."""
    values = [f"nodes.robot.environment.DURATION={SECONDS}", *settings]
    arguments = [argument for value in values for argument in ("--set", value)]
    project = WHISKEYE / f"{variant}.json"
    options = {"cwd": cwd, "timeout_s": TIMEOUT_S, "NEUROS_GUI": "0"}
    run = launch(project, "--backend", backend, *arguments, **options)
    assert run.exit_code == 0, run.output
    return run


def results(run: Finished) -> dict[str, float]:
    return dict(json.loads((run.run_folder / "visualiser/head_direction.json").read_text()))


def counts(run: Finished, connection: str) -> tuple[int, ...]:
    found = run.connection(connection)
    return tuple(found[key] for key in ("sent", "received", "consumed", "discarded", "lost"))


@pytest.fixture(scope="module", params=BACKENDS)
def hybrid(request, tmp_path_factory):
    """One run of project.json on each back end."""
    return whiskeye("project", request.param, tmp_path_factory.mktemp("hybrid"))


def test_the_hybrid_loses_no_imu_packet_and_tracks_the_heading(hybrid):
    assert counts(hybrid, IMU) == (PACKETS, PACKETS, PACKETS, 0, 0)
    assert hybrid.connection(TRUTH)["sent"] == hybrid.connection(ESTIMATE)["sent"] == PACKETS
    found = results(hybrid)
    assert found["rms_deg"] <= 5
    assert found["max_deg"] <= 12
    assert found["samples"]  # the plot may lose packets, more of them on a busy machine
    assert hybrid.record["sim_s"] == pytest.approx(SECONDS)
    assert any(line.startswith("head-direction error: RMS") for line in hybrid.said("visualiser"))


def test_the_visualiser_writes_a_picture_a_table_and_the_error(hybrid):
    folder = hybrid.run_folder / "visualiser"
    assert (folder / "head_direction.png").read_bytes().startswith(b"\x89PNG")
    with (folder / "head_direction.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = results(hybrid)
    for column, count in (("estimate_rad", "estimates"), ("truth_rad", "truths")):
        assert sum(bool(row[column]) for row in rows) == found[count]
    for connection, count in ((ESTIMATE, "estimates"), (TRUTH, "truths")):
        assert hybrid.connection(connection)["consumed"] == found[count]
    true = [int(row["stamp_ns"]) for row in rows if row["truth_rad"]]
    estimated = [int(row["stamp_ns"]) for row in rows if row["estimate_rad"]]
    assert found["samples"] == sum(true[0] <= stamp <= true[-1] for stamp in estimated)


def test_the_strict_variant_is_the_same_bit_for_bit_on_every_back_end(tmp_path):
    tables = []
    for backend in BACKENDS:
        (tmp_path / backend).mkdir()
        run = whiskeye("strict", backend, tmp_path / backend)
        for connection in (IMU, TRUTH, ESTIMATE):
            assert counts(run, connection) == (PACKETS, PACKETS, PACKETS, 0, 0)
        tables.append((run.run_folder / "visualiser/head_direction.csv").read_bytes())
    assert tables[0] == tables[1]
    assert tables[0].count(b"\n") == 1 + PACKETS


@pytest.mark.parametrize(
    ("variant", "setting"),
    [
        ("tick_20ms", "nodes.robot.environment.TICK_SECONDS=0.01"),
        ("asynchronous", "nodes.robot.environment.REAL_TIME_FACTOR=4"),
    ],
    ids=["tick", "asynchronous"],
)
@pytest.mark.parametrize(
    "backend", ["process", pytest.param("in-process", marks=pytest.mark.acceptance)]
)
def test_the_variants_that_may_lose_packets_end_properly(backend, variant, setting, tmp_path):
    run = whiskeye(variant, backend, tmp_path, setting)
    sim_s = run.record["sim_s"]
    assert SECONDS <= sim_s + 1e-6 < SECONDS + 2  # a free simulation notices a little later
    imu = run.connection(IMU)
    assert imu["sent"] == pytest.approx(50 * sim_s, abs=2)
    assert imu["sent"] == imu["received"] + imu["lost"]
    assert imu["received"] == imu["consumed"] + imu["discarded"] + imu["unread"]
    assert imu["consumed"] > 0
    assert (run.run_folder / "visualiser/head_direction.png").exists()
