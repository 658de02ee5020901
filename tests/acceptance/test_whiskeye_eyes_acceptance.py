"""The figures of WhiskEye's eyes, as in its README: some minutes on two cores."""

from __future__ import annotations

import json

import pytest
from launching import EXAMPLES, launch

for needed in ("mujoco", "nest"):
    pytest.importorskip(needed)

pytestmark = [pytest.mark.acceptance, pytest.mark.needs("OpenGL")]

WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
TIMEOUT_S = 600.0
LONGEST_TRAINING_S = 300.0


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The run folder of training.json, as it is."""
    cwd = tmp_path_factory.mktemp("training")
    run = launch(WHISKEYE / "training.json", cwd=cwd, timeout_s=TIMEOUT_S, NEUROS_GUI="0")
    assert run.exit_code == 0, run.output
    return run.run_folder


def test_it_tells_headings_and_places_that_it_has_not_learnt(trained):
    figures = json.loads((trained / "trainer/training.json").read_text())
    assert figures["training_s"] < LONGEST_TRAINING_S
    headings, places = (figures[f"held_out_{held}"] for held in ("headings", "places"))
    assert headings["network"]["rms_deg"] <= 5
    assert places["network"]["rms_deg"] < places["nearest_neighbour"]["rms_deg"]


def predicted(weights, cwd, seed, rate, bias):
    """The errors of 60 s on a way that was not learnt from, by series."""
    cwd.mkdir()
    settings = (
        f"pcn.environment.WEIGHTS={weights}",
        f"snn.environment.SEED={seed}",
        f"snn.environment.GYRO_BIAS={bias}",
        f"robot.environment.SEED={seed}",
        f"robot.environment.RATE={rate}",
    )
    arguments = [argument for each in settings for argument in ("--set", f"nodes.{each}")]
    options = {"cwd": cwd, "timeout_s": TIMEOUT_S, "NEUROS_GUI": "0"}
    run = launch(WHISKEYE / "prediction.json", *arguments, **options)
    assert run.exit_code == 0, run.output
    return json.loads((run.run_folder / "visualiser/correction.json").read_text())


@pytest.mark.parametrize("rate", [1.0, -1.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_it_sees_corrects_a_biased_gyroscope_and_harms_none_that_is_right(
    trained, tmp_path, seed, rate
):
    weights = trained / "trainer/weights.npz"
    biased = predicted(weights, tmp_path / "biased", seed, rate, 0.1)
    assert biased["uncorrected"]["rms_deg"] > 60
    assert biased["corrected"]["rms_deg"] <= 5
    assert biased["corrected"]["max_deg"] <= 15
    right = predicted(weights, tmp_path / "right", seed, rate, 0.0)
    assert right["corrected"]["rms_deg"] <= 5
