"""The head-direction network alone, fed with ideal rates. Offline, no NeuROS.

NEST has one kernel per process; each test builds its network anew, which takes a fifth of a second.
"""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("nest")

EXAMPLE = Path(__file__).parents[2] / "examples/4_neurorobotics/whiskeye"
PERIOD_S = 0.02
SEEDS = (1, 2, 3, 11)


def load(name):
    """A module of the example, under a name of its own."""
    spec = importlib.util.spec_from_file_location(f"whiskeye_{name}", EXAMPLE / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLE)  # for the modules beside it
        spec.loader.exec_module(module)
    return module


head_direction = load("head_direction")
heading_error = load("heading_error")


def settled(seed=1):
    network = head_direction.HeadDirectionNetwork(seed)
    network.settle()
    return network


def headings(rate_rad_s, duration_s, seed=1):
    network = settled(seed)
    return [network.step(rate_rad_s, PERIOD_S) for _ in range(round(duration_s / PERIOD_S))]


def error(rate_rad_s, duration_s, seed, bias_rad_s=0.0):
    """Error against a robot that turns exactly at ``rate_rad_s``."""
    found = headings(rate_rad_s + bias_rad_s, duration_s, seed)
    stamps = [20_000_000 * (index + 1) for index in range(len(found))]
    truths = {stamp: rate_rad_s * stamp * 1e-9 for stamp in stamps}
    wrapped = {stamp: math.remainder(angle, math.tau) for stamp, angle in truths.items()}
    estimates = dict(zip(stamps, found, strict=True))
    return heading_error.heading_error(heading_error.compare(estimates, wrapped))


@pytest.mark.parametrize("rate", [1.0, -1.0])
def test_it_follows_the_turn_to_the_side_it_goes(rate):
    followed = np.unwrap([0.0, *headings(rate, 3.0)])[-1]
    assert followed == pytest.approx(3.0 * rate, abs=math.radians(12))


def test_without_a_turn_the_heading_stays():
    followed = np.degrees(headings(0.0, 2.0))
    assert np.max(np.abs(followed)) < 8
    assert abs(np.mean(followed[50:]) - np.mean(followed[:50])) < 0.5


def test_settling_makes_the_heading_zero():
    network = head_direction.HeadDirectionNetwork(4)
    assert network.settle() == 0.0
    assert network.heading_rad == 0.0


def test_settling_for_less_than_a_second_is_refused():
    with pytest.raises(ValueError, match="too short"):
        head_direction.HeadDirectionNetwork(1).settle(0.5)


@pytest.mark.parametrize("duration_s", [0.0, 0.0005, 0.0203, -0.02])
def test_a_step_that_is_not_a_whole_number_of_quanta_is_refused(duration_s):
    network = head_direction.HeadDirectionNetwork(1)
    assert network.quantum_s == pytest.approx(0.001)
    with pytest.raises(ValueError, match="whole number"):
        network.step(0.0, duration_s)


def test_the_same_seed_gives_the_same_headings_and_another_seed_others():
    first = headings(1.0, 0.4, seed=5)
    assert headings(1.0, 0.4, seed=5) == first
    assert headings(1.0, 0.4, seed=6) != first


def test_the_length_of_the_steps_does_not_change_the_spikes():
    """Decoded over the same last 20 ms, the heading is the same to the last bit."""
    ends = []
    for lengths in ([0.02] * 10, [0.1, 0.06, 0.02, 0.02]):
        network = settled()
        ends.append([network.step(1.0, length) for length in lengths][-1])
    assert ends[0] == ends[1]


@pytest.mark.acceptance
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("rate", "rms_deg", "max_deg", "gain_error"),
    [
        (1.0, 5.0, 12.0, 0.01),
        (-1.0, 5.0, 12.0, 0.01),
        (0.5, 7.0, None, 0.025),
        (2.0, 10.0, None, 0.02),
    ],
)
def test_accuracy_over_twenty_seconds(seed, rate, rms_deg, max_deg, gain_error):
    found = error(rate, 20.0, seed)
    assert found.rms_deg <= rms_deg
    assert max_deg is None or found.max_deg <= max_deg
    assert found.gain == pytest.approx(1.0, abs=gain_error)


@pytest.mark.acceptance
@pytest.mark.parametrize("seed", SEEDS)
def test_drift_at_rest_over_twenty_seconds(seed):
    assert abs(error(0.0, 20.0, seed).drift_deg_s) <= 0.05


@pytest.mark.acceptance
@pytest.mark.parametrize("bias", [0.1, -0.1])
@pytest.mark.parametrize("seed", SEEDS[:3])
def test_a_biased_gyroscope_is_believed(seed, bias):
    found = error(1.0, 20.0, seed, bias)
    assert found.rms_deg > 50
    assert 95 <= found.max_deg <= 130
