"""The node of docs/neural_simulators.md does what the page says."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from needs import COMPILER
from std_msgs.msg import Float64, Float64MultiArray

from neuros.snn import Spikes
from neuros.testing import PluginHarness

pytest.importorskip("nest")

PAGE = Path(__file__).resolve().parents[2] / "docs/neural_simulators.md"
FLOAT = "std_msgs/msg/Float64"


def blocks() -> list[str]:
    """The node, and its hook that sends spikes."""
    ours, _, _ = PAGE.read_text("utf-8").partition("\n## Plasticity\n")
    return re.findall(r"```python\n(.*?)```", ours, re.DOTALL)


def estimates(folder: Path, seed: str) -> list[float]:
    (folder / "snn.py").write_text(blocks()[0])
    with PluginHarness(
        str(folder / "snn.py"),
        inputs={"direction": FLOAT},
        outputs={"estimate": FLOAT},
        environment={"SEED": seed},
        name="snn",
    ) as harness:
        for step in range(50):
            harness.send("direction", Float64(data=0.02 * step))
            harness.run()
        return [packet.data for packet in harness.received("estimate")]


def test_it_decodes_the_direction_that_its_spikes_stand_for_and_repeats_it(tmp_path):
    """100 neurons of 50 Hz are 100 spikes in 20 ms: a standard error of 8 degrees."""
    found = estimates(tmp_path, "1")
    assert found == estimates(tmp_path, "1") != estimates(tmp_path, "2")
    error = np.array(found) - 0.02 * np.arange(50)
    assert np.all(np.abs(error) < math.radians(5 * 8))
    assert np.sqrt(np.mean(error[1:] ** 2)) < math.radians(10)


@pytest.mark.needs(*COMPILER)
def test_its_spikes_are_messages(tmp_path):
    (tmp_path / "snn.py").write_text("\n".join(["from neuros.time import to_stamp", *blocks()]))
    with PluginHarness(
        str(tmp_path / "snn.py"),
        inputs={"direction": FLOAT, "rates": "std_msgs/msg/Float64MultiArray"},
        outputs={"estimate": FLOAT, "spikes": "neuros_msgs/msg/Spikes"},
        environment={"SEED": "1"},
        name="snn",
    ) as harness:
        harness.send("rates", Float64MultiArray(data=[1000.0, *[0.0] * 99]))
        harness.run()
        (packet,) = harness.received("spikes")
    spikes = Spikes.of(packet)
    assert packet.size == 100
    assert {*spikes.neuron} == {0}
    assert 5 <= len(spikes) <= 50  # 20 are expected
    stamp_s = packet.header.stamp.nanosec * 1e-9
    assert 0 < spikes.time_s.min() <= spikes.time_s.max() <= stamp_s <= 0.02
