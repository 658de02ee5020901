"""WhiskEye's published description becomes the robot that was made of its numbers by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from neuros_robots.elements import Finder
from neuros_robots.sdf import convert_sdf

from neuros.distribution import EXAMPLES

HERE = Path(__file__).resolve().parent
BY_HAND = EXAMPLES / "4_neurorobotics/whiskeye/whiskeye.xml"
SIX_DIGITS = 2e-6


@pytest.fixture(scope="module")
def converted() -> Any:
    return convert_sdf(HERE / "whiskeye.sdf", Finder())


@pytest.fixture(scope="module")
def model(converted: Any) -> Any:
    return converted.spec.compile()


@pytest.fixture(scope="module")
def by_hand() -> Any:
    return mujoco.MjModel.from_xml_path(str(BY_HAND))


def names(model: Any, count: int, get: Any) -> list[str]:
    return sorted(get(index).name for index in range(count))


def test_it_has_the_same_links_joints_and_actuators(model: Any, by_hand: Any) -> None:
    assert (model.nbody - 1, model.njnt, model.nu) == (31, 31, 6)
    for kind, count in (("body", "nbody"), ("joint", "njnt"), ("actuator", "nu")):
        ours, theirs = (
            names(which, getattr(which, count), getattr(which, kind)) for which in (model, by_hand)
        )
        assert ours == theirs


def test_every_link_weighs_the_same(model: Any, by_hand: Any) -> None:
    for index in range(1, model.nbody):
        ours = model.body(index)
        theirs = by_hand.body(ours.name)
        np.testing.assert_allclose(ours.mass, theirs.mass)
        np.testing.assert_allclose(ours.ipos, theirs.ipos, atol=SIX_DIGITS)
        np.testing.assert_allclose(ours.inertia, theirs.inertia)


def test_every_joint_turns_about_the_same_axis(model: Any, by_hand: Any) -> None:
    here, there = mujoco.MjData(model), mujoco.MjData(by_hand)
    for data, which in ((here, model), (there, by_hand)):
        mujoco.mj_kinematics(which, data)
    for index in range(model.njnt):
        ours = model.joint(index)
        theirs = by_hand.joint(ours.name)
        assert here.joint(ours.name).xanchor == pytest.approx(
            there.joint(ours.name).xanchor, abs=SIX_DIGITS
        )
        assert here.joint(ours.name).xaxis == pytest.approx(
            there.joint(ours.name).xaxis, abs=SIX_DIGITS
        )
        np.testing.assert_allclose(ours.range, theirs.range, atol=1e-5)
        np.testing.assert_allclose(ours.damping, theirs.damping)
        np.testing.assert_allclose(ours.frictionloss, theirs.frictionloss)


def test_the_cameras_see_the_same(model: Any, by_hand: Any) -> None:
    here, there = mujoco.MjData(model), mujoco.MjData(by_hand)
    mujoco.mj_forward(model, here)
    mujoco.mj_forward(by_hand, there)
    for name, link in (("cam0", "head"), ("cam1", "head"), ("cam2", "body")):
        ours, theirs = here.camera(f"{link}/{name}"), there.camera(name)
        np.testing.assert_allclose(ours.xmat, theirs.xmat, atol=SIX_DIGITS)
        np.testing.assert_allclose(ours.xpos, theirs.xpos, atol=SIX_DIGITS)
        fovy = by_hand.camera(name).fovy
        assert model.camera(f"{link}/{name}").fovy == pytest.approx(fovy, abs=1e-3)


def test_its_controllers_have_the_same_gains_and_limits(model: Any, by_hand: Any) -> None:
    for index in range(model.nu):
        ours = model.actuator(index)
        theirs = by_hand.actuator(ours.name)
        np.testing.assert_allclose(ours.gainprm[:3], theirs.gainprm[:3])
        np.testing.assert_allclose(ours.biasprm[:3], theirs.biasprm[:3])
        np.testing.assert_allclose(ours.forcerange, theirs.forcerange)


def test_it_turns_as_it_is_told(model: Any) -> None:
    data = mujoco.MjData(model)
    data.actuator("pose_theta").ctrl = 1.0
    model.opt.timestep = 0.001
    mujoco.mj_step(model, data, nstep=2000)
    rate = data.sensor("body/imu_body/gyro").data[2]
    assert rate == pytest.approx(1.0, abs=0.002)


def test_what_it_loses_is_listed(converted: Any) -> None:
    paths = {note.path.rpartition("/")[2]: note.count for note in converted.differences}
    assert paths["plugin[gz::sim::systems::Imu]"] == 2
    assert paths["sensor[whisker1_1_contact]"] == 24
    assert paths["clip"] == 3
