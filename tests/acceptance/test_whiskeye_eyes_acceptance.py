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
