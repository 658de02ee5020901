"""WhiskEye's eyes as a user launches them, in seconds; the long rows are in acceptance."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from launching import BACKENDS, EXAMPLES, Finished, launch

from containers import IMAGES, nothing_left, require_containers
from neuros.cli.main import main

for needed in ("mujoco", "nest", "matplotlib"):
    pytest.importorskip(needed)

pytestmark = pytest.mark.needs("OpenGL")

WHISKEYE = EXAMPLES / "4_neurorobotics/whiskeye"
SECONDS = 1
TIMEOUT_S = 400.0


def started(variant: str, backend: str, cwd: Path, *flags: str, **settings: object) -> Finished:
    """Run a project to its end, without windows; ``node__NAME=value`` sets an environment value.

    ``pcn__weights`` is a file with the weights that it takes.
    """
    arguments = [*flags]
    for name, value in settings.items():
        node, variable = name.split("__", 1)
        if variable == "weights":
            arguments += ["--restore", f"{node}.weights={value}"]
            continue
        arguments += ["--set", f"nodes.{node}.environment.{variable}={value}"]
    options = {"cwd": cwd, "timeout_s": TIMEOUT_S, "NEUROS_GUI": "0"}
    run = launch(WHISKEYE / f"{variant}.json", "--backend", backend, *arguments, **options)
    assert run.exit_code == 0, run.output
    return run


@pytest.mark.acceptance  # the variants that learn in the room are below
def test_in_the_room_the_ring_is_the_same_bit_for_bit_on_every_back_end(tmp_path):
    tables = []
    for backend in BACKENDS:
        (tmp_path / backend).mkdir()
        settings = {"robot__DURATION": SECONDS, "robot__NEUROS_RANDOMISE_DIRECTION": 1}
        run = started("room", backend, tmp_path / backend, **settings)
        for each in run.record["connections"]:
            assert each["sent"] == each["consumed"] == 50 * SECONDS, each
        tables.append((run.run_folder / "visualiser/head_direction.csv").read_bytes())
    assert tables[0] == tables[1]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of training.json on each back end."""
    return {
        backend: started(
            "training",
            backend,
            tmp_path_factory.mktemp(backend),
            trainer__VIEWS=60,
            trainer__EPOCHS=2,
        )
        for backend in BACKENDS
    }


@pytest.fixture(scope="module")
def weights(trained):
    return trained[BACKENDS[0]].run_folder / "trainer/weights.npz"


def test_training_learns_the_same_weights_on_every_back_end_and_tells_the_figures(trained):
    found = [np.load(run.run_folder / "trainer/weights.npz") for run in trained.values()]
    for name in found[0].files:
        assert all(np.array_equal(found[0][name], other[name]) for other in found), name
    figures = json.loads((trained[BACKENDS[0]].run_folder / "trainer/training.json").read_text())
    assert 30 < figures["views"]["learnt"] < 60
    assert "views learnt" in trained[BACKENDS[0]].output


@pytest.mark.skipif(
    importlib.util.find_spec("tensorflow") is not None, reason="TensorFlow is in this environment"
)
def test_in_one_process_without_tensorflow_it_says_what_is_missing(tmp_path):
    run = launch(WHISKEYE / "training_tensorflow.json", "--backend", "in-process", cwd=tmp_path)
    assert run.exit_code == 4
    assert "container 'neuros_tensorflow' (node trainer) needs tensorflow-cpu" in run.output
    assert "use --backend process" in run.output


@pytest.mark.acceptance
def test_prediction_is_the_same_bit_for_bit_on_every_back_end(weights, tmp_path):
    tables = []
    for backend in BACKENDS:
        (tmp_path / backend).mkdir()
        settings = {"robot__DURATION": SECONDS, "snn__GATE": 9, "pcn__weights": weights}
        run = started("prediction", backend, tmp_path / backend, **settings)
        for each in run.record["connections"]:
            assert each["sent"] == each["consumed"] > 0, each
        tables.append((run.run_folder / "visualiser/correction.csv").read_bytes())
        errors = json.loads((run.run_folder / "visualiser/correction.json").read_text())
        assert errors["vision"]["samples"] == 10 * SECONDS
        assert errors["uncorrected"]["samples"] == 50 * SECONDS
        assert errors["uncorrected"]["rms_deg"] != errors["corrected"]["rms_deg"]
    assert tables[0] == tables[1]


@pytest.mark.acceptance
def test_five_runs_and_all_back_ends_carry_the_same_packets(weights, tmp_path, capsys):
    require_containers(*IMAGES)
    settings = {"robot__DURATION": 2, "snn__GATE": 9, "pcn__weights": weights}
    runs = []
    with nothing_left(tmp_path):
        for number, backend in enumerate(("process",) * 5 + ("in-process", "docker")):
            cwd = tmp_path / str(number)
            cwd.mkdir()
            run = started("prediction", backend, cwd, "--digests", **settings)
            runs.append(run.run_folder)
    first, *others = runs
    for other in others:
        assert main(["verify", str(first), str(other)]) == 0, other
        assert "identical: " in capsys.readouterr().out


@pytest.mark.acceptance
@pytest.mark.parametrize("backend", BACKENDS)
def test_the_hybrid_loses_no_imu_packet(weights, tmp_path, backend):
    run = started(
        "prediction_hybrid", backend, tmp_path, robot__DURATION=SECONDS, pcn__weights=weights
    )
    assert run.connection("robot.imu -> snn.imu")["consumed"] == 50 * SECONDS
    assert run.connection("pcn.odom_correction -> snn.odom_correction")["sent"] > 0


@pytest.mark.acceptance
def test_the_asynchronous_variant_ends_properly(weights, tmp_path):
    # Slowly: until the rings have settled, packets pass by.
    slowly = {"robot__DURATION": 2 * SECONDS, "robot__REAL_TIME_FACTOR": 0.2}
    settings = {**slowly, "pcn__weights": weights}
    run = started("prediction_asynchronous", BACKENDS[0], tmp_path, **settings)
    assert run.connection("robot.imu -> snn.imu")["consumed"] > 0
    assert (run.run_folder / "visualiser/correction.json").exists()


def test_learning_is_the_same_bit_for_bit_on_every_back_end(weights, tmp_path):
    found = []
    for backend in BACKENDS:
        (tmp_path / backend).mkdir()
        settings = {"robot__DURATION": SECONDS, "pcn__weights": weights}
        settings |= {"pcn__GATE": 0, "pcn__NEW_VIEWS": 8, "pcn__EPOCHS": 2, "snn__GATE": 9}
        run = started("learning", backend, tmp_path / backend, **settings)
        learnt = json.loads((run.run_folder / "snn/results.json").read_text())
        assert learnt["learnt_bias_rad_s"] != 0
        (once,) = json.loads((run.run_folder / "pcn/learning.json").read_text())
        assert once["learnt"] == 6
        found.append((run.run_folder / "visualiser/correction.csv").read_bytes())
    assert found[0] == found[1]
