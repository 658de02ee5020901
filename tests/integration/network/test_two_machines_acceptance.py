"""What is promised for a network that loses a tenth of all packets. Long runs."""

from __future__ import annotations

import json
import statistics
from pathlib import Path

import pytest
from launching import EXAMPLES, Finished
from two_machines import TwoMachines

pytestmark = pytest.mark.acceptance

STREAM = Path(__file__).parent / "stream"
WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
PATIENCE_S = 120.0
LATE_MS = 50.0  # at most, for 95 of 100 packets at limit 0


def test_at_limit_0_all_packets_arrive_and_nineteen_of_twenty_within_50_ms(
    machines: TwoMachines, backend: str, tmp_path: Path
) -> None:
    machines.lose(0.1)
    count = ("--set", "nodes.source.environment.COUNT=2000", "--network", "--backend", backend)
    with (
        machines.start("left", STREAM, "-n", "source", *count, cwd=tmp_path) as source,
        machines.start("right", STREAM, "-n", "sink", *count, cwd=tmp_path) as sink,
    ):
        finished = sink.finish(PATIENCE_S)
        assert source.finish().exit_code == finished.exit_code == 0
    assert finished.run_folder is not None
    received = json.loads((finished.run_folder / "sink" / "received.json").read_text())
    assert received["numbers"] == list(range(1, 2001))
    ages_ms = [1e3 * age_s for age_s in received["ages_s"]]
    assert statistics.quantiles(ages_ms, n=20)[-1] <= LATE_MS


@pytest.mark.parametrize("loss", [0.0, 0.1])
@pytest.mark.parametrize("variant", ["project.json", "strict.json", "asynchronous.json"])
def test_whiskeye_on_two_machines(
    variant: str, loss: float, machines: TwoMachines, backend: str, tmp_path: Path
) -> None:
    if loss:
        machines.lose(loss)
    here, there = ("-n", "robot"), ("-n", "snn", "-n", "visualiser")
    common = ("--network", "--backend", backend)
    with (
        machines.start("left", WHISKEYE / variant, *here, *common, cwd=tmp_path) as robot,
        machines.start("right", WHISKEYE / variant, *there, *common, cwd=tmp_path) as rest,
    ):
        ended = [rest.finish(PATIENCE_S), robot.finish(PATIENCE_S)]
    for finished in ended:
        assert finished.exit_code == 0, finished.output
        assert_delivery(finished, is_lossless=variant != "asynchronous.json", loss=loss)


def assert_delivery(finished: Finished, *, is_lossless: bool, loss: float) -> None:
    imu = finished.connection("robot.imu -> snn.imu")
    assert imu["sent"] >= 990
    if is_lossless:
        assert imu["received"] == imu["consumed"] == imu["sent"]
    else:
        assert imu["lost"] == imu["sent"] - imu["received"] >= imu["sent"] * loss / 2
