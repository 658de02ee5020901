"""The figures of WhiskEye's eyes, as in its README: about an hour on two cores."""

from __future__ import annotations

import json

import pytest
from launching import EXAMPLES, launch

for needed in ("mujoco", "nest"):
    pytest.importorskip(needed)

pytestmark = [pytest.mark.acceptance, pytest.mark.needs("OpenGL")]

WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
TIMEOUT_S = 900.0
LONGEST_TRAINING_S = 300.0
BIAS_RAD_S = 0.1


@pytest.fixture(scope="module", params=[1, 2, 3])
def seed(request):
    """Of the robot's way, of the weights and of the rings."""
    return request.param


@pytest.fixture(scope="module")
def trained(seed, tmp_path_factory):
    """The run folder of training.json, once per seed; seed 1 as it is."""
    settings = (f"trainer.environment.SEED={seed}", f"robot.environment.SEED={100 + seed}")
    return launched("training", settings, tmp_path_factory.mktemp("training"))


def launched(project, settings, cwd):
    """The folder of a run that has ended well."""
    arguments = [argument for each in settings for argument in ("--set", f"nodes.{each}")]
    options = {"cwd": cwd, "timeout_s": TIMEOUT_S, "NEUROS_GUI": "0"}
    run = launch(WHISKEYE / f"{project}.json", *arguments, **options)
    assert run.exit_code == 0, run.output
    return run.run_folder


def test_it_tells_headings_and_places_that_it_has_not_learnt(trained):
    figures = json.loads((trained / "trainer/training.json").read_text())
    assert figures["training_s"] < LONGEST_TRAINING_S
    headings, places = (figures[f"held_out_{held}"] for held in ("headings", "places"))
    assert headings["network"]["rms_deg"] <= 5
    assert places["network"]["rms_deg"] < places["nearest_neighbour"]["rms_deg"]


def closed_loop(project, trained, cwd, seed, rate, bias, **robot):
    """The folder of a run with the trained network, on a way that was not learnt from."""
    cwd.mkdir()
    settings = (
        f"pcn.environment.WEIGHTS={trained / 'trainer/weights.npz'}",
        f"snn.environment.SEED={seed}",
        f"snn.environment.GYRO_BIAS={bias}",
        f"robot.environment.SEED={seed}",
        f"robot.environment.RATE={rate}",
        *(f"robot.environment.{name}={value}" for name, value in robot.items()),
    )
    return launched(project, settings, cwd)


def errors_of(folder):
    """RMS and maximum of the error in degrees, by series."""
    return json.loads((folder / "visualiser/correction.json").read_text())


@pytest.mark.parametrize("rate", [1.0, -1.0])
def test_what_it_sees_corrects_a_biased_gyroscope_and_harms_none_that_is_right(
    trained, tmp_path, seed, rate
):
    biased = errors_of(
        closed_loop("prediction", trained, tmp_path / "biased", seed, rate, BIAS_RAD_S)
    )
    assert biased["uncorrected"]["rms_deg"] > 60
    assert biased["corrected"]["rms_deg"] <= 5
    assert biased["corrected"]["max_deg"] <= 15
    right = errors_of(closed_loop("prediction", trained, tmp_path / "right", seed, rate, 0.0))
    assert right["corrected"]["rms_deg"] <= right["uncorrected"]["rms_deg"]


@pytest.mark.parametrize("rate", [1.0, -1.0])
def test_the_bias_of_the_gyroscope_is_learnt_within_a_minute(trained, tmp_path, seed, rate):
    folder = closed_loop("learning", trained, tmp_path / "run", seed, rate, BIAS_RAD_S, DURATION=60)
    results = json.loads((folder / "snn/results.json").read_text())
    assert results["learnt_bias_rad_s"] == pytest.approx(BIAS_RAD_S, rel=0.1)


def test_new_views_are_learnt_and_the_old_ones_are_not_forgotten(trained, tmp_path, seed):
    folder = closed_loop("learning", trained, tmp_path / "run", seed, 1.0, BIAS_RAD_S)
    rounds = json.loads((folder / "pcn/learning.json").read_text())
    before, after = rounds[0]["before"], rounds[0]["after"]
    assert after["new"]["rms_deg"] < before["new"]["rms_deg"] / 2
    assert after["new"]["view_error"] < before["new"]["view_error"] / 2
    assert after["old"]["rms_deg"] <= 5
