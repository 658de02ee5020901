"""The figures of WhiskEye's eyes with the seeds 1, 2 and 3: more than an hour on two cores.

``NEUROS_HEADDIRECTION`` names the folder of a ``neuros reproduce headdirection --repeat 3`` that
was made before: it is judged, and not made again.
"""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import pytest
from launching import EXAMPLES, launch

from benchmarks.reproduce.headdirection import CRITERIA
from neuros.cli.main import main

for needed in ("mujoco", "nest"):
    pytest.importorskip(needed)

pytestmark = [pytest.mark.acceptance, pytest.mark.needs("OpenGL")]

WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
SEEDS = (1, 2, 3)
TIMEOUT_S = 1800.0


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of the experiment."""
    if before := os.environ.get("NEUROS_HEADDIRECTION"):
        return Path(before)
    folder = tmp_path_factory.mktemp("headdirection") / "made"
    command = ["reproduce", "headdirection", "--repeat", str(len(SEEDS)), "--backend", "process"]
    assert main([*command, "-o", str(folder)]) == 0
    return folder


def test_every_run_has_what_is_wanted_of_it(made):
    with (made / "tables/acceptance.csv").open(newline="") as file:
        rows = [*csv.reader(file)][1:]
    counts = [len(SEEDS) * len(each.parts) for each in CRITERIA]
    assert [row[-1] for row in rows] == [f"yes ({count} of {count})" for count in counts], rows


@pytest.mark.parametrize("seed", SEEDS)
def test_new_views_are_learnt_and_the_old_ones_are_not_forgotten(made, tmp_path, seed):
    settings = (
        f"snn.environment.SEED={seed}",
        f"robot.environment.SEED={seed}",
    )
    arguments = [word for each in settings for word in ("--set", f"nodes.{each}")]
    weights = made / f"runs/training-{seed}/trainer/weights.npz"
    arguments += ["--restore", f"pcn.weights={weights}"]
    options = {"cwd": tmp_path, "timeout_s": TIMEOUT_S, "NEUROS_GUI": "0"}
    run = launch(WHISKEYE / "learning.json", "--backend", "process", *arguments, **options)
    assert run.exit_code == 0, run.output
    rounds = json.loads((run.run_folder / "pcn/learning.json").read_text())
    before, after = rounds[0]["before"], rounds[0]["after"]
    assert after["new"]["rms_deg"] < before["new"]["rms_deg"] / 2
    assert after["new"]["view_error"] < before["new"]["view_error"] / 2
    assert after["old"]["rms_deg"] <= 5
