"""The ant that a pattern generator walks: its body, its rhythm, what couples its legs, its gait."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples/9_legs/ant"
STEPS_PER_S = 50

pytest.importorskip("gymnasium")


@pytest.fixture
def standing(load):
    """The model, its data, and the plugin: an ant that has come to stand on its four feet."""
    mujoco = pytest.importorskip("mujoco")
    body = load("body")
    data = mujoco.MjData(body.ant(0.0, 1).compile())
    data.ctrl[1::2] = body.DOWN * body.ANKLE_RAD[0]
    data.qpos[8::2] = data.ctrl[1::2]
    mujoco.mj_step(data.model, data, 200)
    return data.model, data, body


def test_each_foot_feels_the_ground_that_it_stands_on(standing):
    _, data, _ = standing
    weight = 9.81 * data.model.body_subtreemass[0]
    assert np.all(data.sensordata > 0)
    assert data.sensordata.sum() == pytest.approx(weight, rel=0.1)


def test_full_power_moves_every_foot_backwards_and_down(standing):
    import mujoco

    model, data, body = standing
    feet = [model.site(f"foot_{leg}").id for leg in range(1, 5)]
    placed = []
    for power in (-1.0, 1.0):
        data.qpos[7::2] = body.BACKWARDS * body.HIP_RAD * power
        data.qpos[8::2] = body.DOWN * (body.ANKLE_RAD[0] + body.ANKLE_RAD[1] * power)
        mujoco.mj_kinematics(model, data)
        placed.append(data.site_xpos[feet].copy())
    assert np.all(placed[1][:, 0] < placed[0][:, 0] - 0.2)
    assert np.all(placed[1][:, 2] < placed[0][:, 2] - 0.1)


def test_each_servo_drives_the_joint_of_its_name(standing):
    model, _, _ = standing
    names = [model.joint(model.actuator_trnid[k, 0]).name for k in range(model.nu)]
    assert names == [f"{part}_{leg}" for leg in range(1, 5) for part in ("hip", "ankle")]


def test_rough_ground_is_that_of_its_seed_and_leaves_room_to_begin(load):
    pytest.importorskip("mujoco")
    body = load("body")
    models = [body.ant(0.15, seed).compile() for seed in (1, 1, 2)]
    slabs = [m.geom_pos[m.geom_bodyid == 0][1:] for m in models]
    assert len(slabs[0]) > 300
    assert np.array_equal(slabs[0], slabs[1])
    assert not np.array_equal(slabs[0][:100], slabs[2][:100])
    assert np.linalg.norm(slabs[0][:, :2], axis=1).min() > 1.0


def test_without_gymnasium_it_says_what_to_install(load, monkeypatch):
    pytest.importorskip("mujoco")
    body = load("body")
    monkeypatch.setattr(body, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'gymnasium>=1\.0,<2'"):
        body.ant_file()


@pytest.mark.parametrize(("shift", "expected"), [(0.0, 1.0), (1.0, 1.0)])
def test_diagonal_legs_that_move_together_trot(load, shift, expected):
    study = load("study")
    at = np.arange(1000) * study.STEP_S
    power = np.sin(2 * np.pi * 1.3 * at[:, None] + study.TROT + shift)
    found = study.measured(power, np.stack([0.4 * at, 0 * at, 0 * at], axis=1))
    assert found["trot"] == pytest.approx(expected, abs=0.01)
    assert found["frequency_hz"] == pytest.approx(1.3, rel=0.02)
    assert found["speed_m_s"] == pytest.approx(0.4)


@pytest.mark.parametrize("gait", [[0, 0, 0, 0], [0, 0, np.pi, np.pi], [0, np.pi / 2, np.pi, -1.57]])
def test_another_gait_is_no_trot(load, gait):
    study = load("study")
    at = np.arange(1000)[:, None] * study.STEP_S
    phase = study.phases(np.sin(2 * np.pi * 1.3 * at + np.array(gait)))
    assert study.trot(phase)[250:].max() < 0.1


def powers(brain, touch, seconds):
    found = np.array([brain.step(np.asarray(touch)) for _ in range(seconds * STEPS_PER_S)])
    brain.stepper.close()
    return found


def test_coupled_legs_trot_and_each_leg_swings_without_a_body(load):
    pytest.importorskip("nest")
    brain, study = load("brain"), load("study")
    coupled = powers(brain.Brain(1, -8.0, 0.0), np.zeros(4), 8)
    assert coupled.min(0).max() < -0.5
    assert coupled.max(0).min() > 0.5
    assert study.trot(study.phases(coupled))[150:-50].mean() > 0.9


@pytest.mark.parametrize(("feedback_pa", "sign"), [(200.0, 1), (-200.0, -1)])
def test_touch_lengthens_the_stance_of_its_leg_or_the_swing(load, feedback_pa, sign):
    pytest.importorskip("nest")
    touched = powers(load("brain").Brain(1, 0.0, feedback_pa), [1, 0, 0, 0], 4)[50:].mean(0)
    assert sign * touched[0] > 0.15 + np.abs(touched[1:]).max()


def test_it_walks_forwards_and_repeats_bit_for_bit(load):
    pytest.importorskip("nest")
    study = load("study")
    coupled = study.settings(("coupled", "no touch"))
    first, again = (study.run(1, coupled, seconds=6) for _ in range(2))
    other, _ = study.run(2, coupled, seconds=6)
    for one, two in zip(first, again, strict=True):
        assert np.array_equal(one, two)
    assert not np.array_equal(first[0], other)
    assert first[1][-1, 0] > 0.8


@pytest.mark.acceptance
def test_coupling_or_touch_makes_the_trot(load, tmp_path):
    study = load("study")
    found, shown = study.study(range(1, 5))
    means = {name: np.mean([each["trot"] for each in runs]) for name, runs in found.items()}
    assert means["coupled", "no touch"] > 0.9
    assert means["not coupled", "no touch"] < 0.7
    assert means["not coupled", "touch is swing"] > 0.9
    assert means["not coupled", "touch is stance"] < 0.7
    study.draw(found, shown, tmp_path / "study.png")
    assert (tmp_path / "study.png").stat().st_size > 10_000
