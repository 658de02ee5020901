"""WhiskEye's model: what it consists of, and that it turns as commanded. Offline, no NeuROS."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

mujoco = pytest.importorskip("mujoco")

MODEL = Path(__file__).parents[2] / "examples/4_neurorobotics/whiskeye/whiskeye.xml"


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_path(str(MODEL))


def turn(model, rate_rad_s, duration_s):
    """Yaw at every IMU period (0.02 s), in rad, and the final state."""
    data = mujoco.MjData(model)
    data.actuator("pose_theta").ctrl = rate_rad_s
    data.actuator("neck_gmbl").ctrl = math.pi / 2
    steps = round(0.02 / model.opt.timestep)
    yaw = []
    for _ in range(round(duration_s / 0.02)):
        mujoco.mj_step(model, data, steps)
        yaw.append(data.joint("pose_theta").qpos[0])
    return yaw, data


def test_it_has_31_links_and_31_joints_and_weighs_what_whiskeye_weighs(model):
    assert model.nbody - 1 == 31  # the world is a body, too
    assert model.njnt == 31
    assert sum(model.body_mass) == pytest.approx(11.4903, abs=1e-6)


def test_it_has_24_whiskers_three_cameras_and_six_controllers(model):
    names = [model.joint(index).name for index in range(model.njnt)]
    assert sum(name.startswith("head_whisker") for name in names) == 24
    assert [model.camera(index).name for index in range(model.ncam)] == ["cam2", "cam0", "cam1"]
    actuators = {model.actuator(index).name for index in range(model.nu)}
    assert actuators == {
        "pose_x",
        "pose_y",
        "pose_theta",
        "body_neck",
        "neck_gmbl",
        "gmbl_head",
    }


def test_only_the_wheels_and_the_floor_collide_and_without_friction(model):
    geoms = [model.geom(index) for index in range(model.ngeom)]
    sought = {geom.conaffinity[0] for geom in geoms} - {0}
    assert sought == {1}
    colliding = [geom for geom in geoms if geom.contype[0] & 1 or geom.conaffinity[0]]
    assert {geom.name for geom in colliding} == {"floor", "wheel_1", "wheel_2", "wheel_3"}
    assert all(geom.condim[0] == 1 for geom in colliding)


def test_the_imu_sits_at_the_origin_of_the_body(model):
    site = model.site("imu_body")
    assert model.body(site.bodyid[0]).name == "body"
    assert list(site.pos) == [0.0, 0.0, 0.0]


def test_the_head_cameras_look_forward_and_up_once_the_gimbal_is_lowered(model):
    _, data = turn(model, 0.0, 2.0)
    for name, side in (("cam0", 1), ("cam1", -1)):
        looking = -data.camera(name).xmat.reshape(3, 3)[:, 2]
        assert looking[0] > 0.7
        assert looking[2] > 0.3
        assert side * looking[1] > 0.3


@pytest.mark.parametrize("rate", [1.0, -1.0, 0.5])
def test_it_turns_at_the_commanded_rate_and_stays_in_its_place(model, rate):
    yaw, data = turn(model, rate, 2.0)
    assert (yaw[-1] - yaw[24]) / 1.5 == pytest.approx(rate, abs=0.002)
    assert abs(data.joint("pose_x").qpos[0]) < 0.002
    assert abs(data.joint("pose_y").qpos[0]) < 0.002
    assert data.warning.number.sum() == 0


@pytest.mark.acceptance
@pytest.mark.parametrize("timestep", [0.001, 0.002])
def test_twenty_seconds_at_one_radian_per_second(timestep):
    model = mujoco.MjModel.from_xml_path(str(MODEL))
    model.opt.timestep = timestep
    yaw, _ = turn(model, 1.0, 20.0)
    assert (yaw[-1] - yaw[49]) / 19.0 == pytest.approx(1.0, abs=0.002)
    worst = max(abs(value - 0.02 * (index + 1)) for index, value in enumerate(yaw))
    assert math.degrees(worst) <= 0.5
