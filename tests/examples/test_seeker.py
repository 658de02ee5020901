"""The vehicle that learns by reward to turn to a lamp: its parts, that it learns, and controls."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples/8_plasticity/seeker"
EPISODES = "nodes.teacher.environment.EPISODES"


@pytest.fixture
def teacher(load):
    teacher = load("teacher").Teacher(1, 1.0)
    teacher.lamp = np.array([0.0, 3.0])  # to the left
    teacher.angle = math.pi / 2
    return teacher


@pytest.mark.parametrize(
    ("turned", "reward"), [(0.01, 0.5), (0.02, 1.0), (0.5, 1.0), (-0.01, -0.5), (-0.5, -1.0)]
)
def test_the_reward_is_the_turn_towards_the_lamp(teacher, turned, reward):
    assert teacher.reward([0.0, 0.0, turned]) == pytest.approx(reward)
    assert teacher.reward([0.0, 0.0, turned]) == pytest.approx(0.0)


@pytest.mark.parametrize("sign", [-1.0, 0.0])
def test_a_control_inverts_the_reward_or_gives_none(teacher, sign):
    teacher.sign = sign
    assert teacher.reward([0.0, 0.0, 0.01]) == pytest.approx(0.5 * sign)


def test_the_lamp_is_on_either_side_of_where_the_vehicle_looks(teacher):
    pose = np.array([1.0, -2.0, 3.0])
    found = []
    for _ in range(50):
        teacher.place_lamp(pose)
        found.append(math.degrees(teacher.bearing(pose)))
        assert math.dist(teacher.lamp, pose[:2]) == pytest.approx(3.0)
    assert all(30 <= abs(angle) <= 120 for angle in found)
    assert {angle > 0 for angle in found} == {True, False}


@pytest.mark.parametrize(
    ("lamp", "brighter"), [((0.0, 3.0), 0), ((0.0, -3.0), 1), ((-3.0, 0.0), None)]
)
def test_the_eye_on_the_side_of_the_lamp_sees_more(load, lamp, brighter):
    mujoco = pytest.importorskip("mujoco")
    vehicle = load("vehicle")
    data = mujoco.MjData(mujoco.MjModel.from_xml_path(str(EXAMPLE / "vehicle.xml")))
    data.mocap_pos[0, :2] = lamp
    mujoco.mj_forward(data.model, data)
    eyes = vehicle.seen(data)
    if brighter is None:
        assert eyes == pytest.approx([0.0, 0.0])
    else:
        assert eyes[brighter] > 0.6
        assert eyes[1 - brighter] == 0.0


def test_it_learns_by_reward_and_what_it_learnt_stays_when_frozen(load, tmp_path, monkeypatch):
    pytest.importorskip("nest")
    study = load("study")
    monkeypatch.chdir(tmp_path)
    short = {EPISODES: 20}
    rewarded, weights = study.run(1, short)
    inverted, _ = study.run(1, short | {study.REWARD: -1})
    frozen = short | study.FROZEN
    before, unchanged = study.run(1001, frozen)
    after, still = study.run(1001, frozen, restore={"brain.weights": rewarded})
    shares = [study.towards(each).mean() for each in (before, after)]
    assert study.towards(rewarded)[-10:].mean() >= 0.8
    assert study.towards(inverted)[-10:].mean() <= 0.2
    assert shares[0] < 0.5 < 0.8 <= shares[1]
    assert np.ptp(unchanged) == 0.0
    assert np.array_equal(still[0], rewarded.kept("brain.weights"))
    assert np.ptp(still, axis=0).max() == 0.0
    crossed = np.mean([weights[-1, :10, 10:], weights[-1, 10:, :10]])
    assert crossed > 1.5 * np.mean([weights[-1, :10, :10], weights[-1, 10:, 10:]])


@pytest.mark.acceptance
def test_only_a_reward_that_is_more_than_expected_teaches_lastingly(load, tmp_path, monkeypatch):
    study = load("study")
    monkeypatch.chdir(tmp_path)
    learnt, frozen, weights = study.study(range(1, 5))
    last = {name: np.mean(np.array(each)[:, -10:]) for name, each in learnt.items()}
    assert last["reward"] > 0.9
    assert last["reward inverted"] < 0.1
    assert 0.05 < last["no reward"] < 0.4
    assert last["nothing is expected"] < 0.7
    assert np.mean(frozen["reward"]) > 0.9
    assert np.mean(frozen["before"]) < 0.4
    study.draw(learnt, frozen, weights, "study.png")
    assert Path("study.png").stat().st_size > 10_000
