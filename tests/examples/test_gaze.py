"""The cerebellum that learns to hold the gaze: its parts, that it learns, and controls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples/8_plasticity/gaze"


def test_the_chair_turns_by_three_sines_of_its_seed(load):
    chair = load("chair")
    turns = []
    for seed in (1, 1, 2):
        one = chair.Chair(seed, 1.0, 1.0)
        turns.append([])
        for one.steps in range(1000):
            turns[-1].append(one.turn())
    assert turns[0] == turns[1] != turns[2]
    assert 0.4 < np.std(turns[0]) < 0.6
    assert np.max(np.abs(turns)) <= 1.2


def test_the_slip_is_a_share_of_the_turns(load):
    chair = load("chair").Chair(1, 1.0, 1.0)
    chair.squares = [(1.0, 0.25)] * 250 + [(4.0, 4.0)] * 250
    assert chair.slips() == pytest.approx([0.5, 1.0])


@pytest.mark.parametrize(("glasses", "slip"), [(1, 0.2), (2, 0.7)])
def test_the_picture_slips_by_what_the_eye_does_not_make_up_for(load, monkeypatch, glasses, slip):
    mujoco = pytest.importorskip("mujoco")
    monkeypatch.setenv("GLASSES", str(glasses))
    data = mujoco.MjData(mujoco.MjModel.from_xml_path(str(EXAMPLE / "head.xml")))
    data.joint("neck").qvel, data.joint("eye").qvel = 0.5, -0.3
    mujoco.mj_forward(data.model, data)
    turn, slips = load("head").felt(data)
    assert turn == pytest.approx([0.5])
    assert slips == pytest.approx([slip])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_an_error_weakens_what_held_the_eye_back(load, sign):
    """A picture that slips to the left asks for an eye that turns to the right."""
    pytest.importorskip("nest")
    brain = load("brain").Brain(1, True, 1000.0)
    first = brain.weights.read()
    for _ in range(50):
        brain.step(0.0, sign * 0.5)
    brain.stepper.close()
    changes = brain.weights.read() - first
    left, right = changes[:, :10].mean(), changes[:, 10:].mean()
    assert sign * left > 1.0
    assert sign * right < -1.0


def test_it_learns_from_the_error_and_holds_the_gaze_when_frozen(load, tmp_path, monkeypatch):
    pytest.importorskip("nest")
    study = load("study")
    monkeypatch.chdir(tmp_path)
    taught = study.run(1, {study.SECONDS: 30})
    inverted = study.run(1, {study.SECONDS: 10, study.ERROR: -1})
    absent = study.run(1, {study.SECONDS: 10, study.ERROR: 0})
    test = {**study.FROZEN, study.SEED: 1001, study.SECONDS: 10}
    before = study.run(1, test)
    after = study.run(1, test, restore={"brain.weights": taught})
    assert study.slips(taught)[-1] < 0.3
    assert study.slips(inverted)[-1] > 1.0
    assert study.slips(absent).mean() > 0.4
    assert study.slips(after).mean() < 0.7 * study.slips(before).mean()
    assert np.array_equal(after.kept("brain.weights"), taught.kept("brain.weights"))
    assert np.ptp(before.kept("brain.weights")) == 0.0


@pytest.mark.acceptance
def test_the_expansion_in_time_is_what_the_filter_needs(load, tmp_path, monkeypatch):
    study = load("study")
    monkeypatch.chdir(tmp_path)
    learnt, frozen = study.study((1, 2))
    other = {name: np.mean(slip) for name, slip in frozen["other turns"].items()}
    assert other["error"] < 0.6 * other["before"]
    assert other["error"] < 0.8 * other["fast granule cells"]
    assert other["error inverted"] > 1.0
    study.draw(learnt, frozen, "study.png")
    assert Path("study.png").stat().st_size > 10_000
