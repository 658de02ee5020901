"""WhiskEye's room: the robot that stands in it, the way that it takes, and what its eyes send."""

from __future__ import annotations

import json
import math
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from neuros.testing import PluginHarness

mujoco = pytest.importorskip("mujoco")

EXAMPLE = Path(__file__).parents[2] / "examples/4_neurorobotics/whiskeye"
PICTURE_BYTES = 80 * 60 * 3


@pytest.fixture(scope="module")
def room():
    return mujoco.MjModel.from_xml_path(str(EXAMPLE / "room.xml"))


def test_the_robot_in_the_room_is_that_of_whiskeye_xml_without_its_cues(room):
    alone = mujoco.MjModel.from_xml_path(str(EXAMPLE / "whiskeye.xml"))
    assert (room.nbody, room.njnt, room.nu, room.ncam) == (32, 31, 6, 3)
    assert np.array_equal(room.body_mass, alone.body_mass)
    assert np.array_equal(room.cam_quat, alone.cam_quat)
    assert room.opt.timestep == alone.opt.timestep


def test_wheels_stand_on_the_floor_and_all_else_of_the_robot_touches_only_the_cues(room):
    geoms = [room.geom(index) for index in range(room.ngeom)]
    touching = {
        (robot.name or "else", other.name or "cue")
        for robot in geoms
        for other in geoms
        if robot.bodyid[0] and robot.contype[0] & other.conaffinity[0]
    }
    wheels = {f"whiskeye/wheel_{wheel}" for wheel in (1, 2, 3)}
    on_wheels = {(wheel, other) for wheel in wheels for other in ("ground", *wheels)}
    assert touching == {("else", "cue"), *on_wheels}


def test_the_cues_are_irregular(room):
    cues = [
        index
        for index in range(room.ngeom)
        if room.geom_bodyid[index] == 0 and room.geom(index).name != "ground"
    ]
    sizes = {tuple(np.round(room.geom_size[index], 3)) for index in cues}
    assert len(cues) > 40
    assert len(sizes) == len(cues)
    assert len({tuple(room.geom_rgba[index]) for index in cues}) == 10


@pytest.mark.needs("OpenGL")
def test_training_and_test_take_other_ways_with_one_seed():
    """A sweep gives all nodes the same SEED."""
    ends = []
    for project in ("training.json", "prediction.json"):
        same = {"SEED": "1", "RATE": "1", "SPEED": "0.4", "NEUROS_RANDOMISE_DIRECTION": "0"}
        with PluginHarness.from_project(EXAMPLE / project, "robot", environment=same) as robot:
            robot.run(executions=1)
            data = robot.node.get_user_data().sim.data
            ends.append([data.actuator(f"whiskeye/pose_{axis}").ctrl[0] for axis in "xy"])
    directions = [math.atan2(y, x) for x, y in ends]
    assert abs(math.remainder(directions[0] - directions[1], math.tau)) > 0.1


def way(wanderer, seconds, step_s=0.02):
    """Positions and rates of a base that does as it is told."""
    place, told = np.zeros(2), []
    for step in range(round(seconds / step_s)):
        vx, vy, rate = wanderer.velocities(step * step_s, *place)
        place = place + step_s * np.array([vx, vy])
        told.append((*place, rate))
    return np.array(told)


def test_it_drives_about_and_stays_in_its_disc(load):
    wandering = load("wandering")
    told = way(wandering.Wanderer(1.0, randomise=False, speed_m_s=0.3, seed=3), 120)
    distance = np.hypot(told[:, 0], told[:, 1])
    assert distance.max() < wandering.RADIUS_M + 0.01
    assert distance.max() > wandering.RADIUS_M / 2
    assert np.all(told[:, 2] == 1.0)
    speeds = np.hypot(*np.diff(told[:, :2], axis=0).T) / 0.02
    assert speeds.max() == pytest.approx(0.3)


def test_randomised_it_turns_both_ways_for_one_to_four_seconds_at_least(load):
    wanderer = load("wandering").Wanderer(-0.7, randomise=True, speed_m_s=0.0, seed=4)
    told = way(wanderer, 120)
    assert np.all(told[:, :2] == 0.0)
    assert Counter(np.abs(told[:, 2])) == {0.7: 6000}
    changes = 0.02 * np.flatnonzero(np.diff(told[:, 2]))
    assert len(changes) > 10
    assert min(after - before for before, after in pairwise(changes)) > 0.9


def test_a_way_is_a_function_of_its_seed(load):
    def drawn(seed):
        wanderer = load("wandering").Wanderer(1.0, randomise=True, speed_m_s=0.3, seed=seed)
        return way(wanderer, 20)

    assert np.array_equal(drawn(1), drawn(1))
    assert not np.array_equal(drawn(1), drawn(2))


def declared(node):
    return json.loads((EXAMPLE / f"room_{node}.json").read_text())["outputs"]


@pytest.mark.needs("OpenGL")
def test_its_eyes_see_at_10_hz_and_the_body_camera_at_5():
    environment = {"DURATION": "0.4", "RATE": "1.0"}
    with PluginHarness.from_project(
        EXAMPLE / "room.json", "robot", environment=environment
    ) as robot:
        robot.run(40)
        sent = {output["name"]: robot.received(output["name"]) for output in declared("robot")}
        assert {name: len(packets) for name, packets in sent.items()} == {
            "imu": 20,
            "pose": 20,
            "left_eye": 4,
            "right_eye": 4,
            "body_camera": 2,
        }
        assert robot.shutdown_reason == "0.4 s simulated"
    pictures = [packet.data for packet in sent["left_eye"]]
    assert {len(data) for data in pictures} == {PICTURE_BYTES}
    assert len({bytes(data) for data in pictures}) == len(pictures)
    last = sent["pose"][-1].pose
    assert 2 * math.asin(last.orientation.z) == pytest.approx(0.4, abs=0.03)
    assert math.hypot(last.position.x, last.position.y) == pytest.approx(0.08, abs=0.02)


@pytest.mark.needs("OpenGL")
def test_the_room_changes_its_colours_once_and_the_way_goes_on():
    seen, turned = [], []
    for change_s in ("inf", "0.15"):
        environment = {"DURATION": "0.3", "CHANGE_S": change_s}
        with PluginHarness.from_project(
            EXAMPLE / "learning.json", "robot", environment=environment
        ) as robot:
            robot.run()
            pictures = [packet for packet in robot.received("left_eye") if packet.height]
            seen.append([np.frombuffer(packet.data, np.uint8) for packet in pictures])
            turned.append([packet.angular_velocity.z for packet in robot.received("imu")])
    assert turned[0] == turned[1]
    differing = [np.mean(same != other) for same, other in zip(*seen, strict=True)]
    assert differing[0] == 0
    assert min(differing[1:]) > 0.2
