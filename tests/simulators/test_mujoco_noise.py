"""Noise of declared sensors: as large as declared, drawn from the seed of the node alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from simulated_node import WORLD, SimulatedNode

import neuros
from neuros.errors import ModelError, ProjectError
from neuros.simulators.mujoco import MuJoCo

IMU, IMAGE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/Image"
SEED = {"SEED": "1"}
DEADLINE_S = 60.0
CUP = """<mujoco><worldbody><body name="cup" pos="0 3 5"><freejoint/><geom size=".1"/></body>
</worldbody></mujoco>"""
PLUGIN = """
from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo

@neuros_initialise()
def begin(node):
    node.set_user_data(MuJoCo(node, "world.xml"))

@neuros_function(outputs="imu")
def step(node):
    node.get_user_data().step_to_next()
    return node.get_user_data().read("imu")
"""


def gyroscope(element="axis_imu", rate=100, **keys):
    return IMU, {"sensor": "imu", "element": element, "rate": rate, **keys}


def simulation(*outputs, model=WORLD):
    named = {f"out{number}": output for number, output in enumerate(outputs)}
    return MuJoCo(SimulatedNode(named, environment=SEED), model)


def turned(sim, count, output="out0"):
    """The angular velocities of so many packets, ``(count, 3)``, in rad/s."""
    found = []
    for _ in range(count):
        sim.step_to_next()
        vector = sim.read(output).angular_velocity
        found.append((vector.x, vector.y, vector.z))
    return np.array(found)


def test_a_gyroscope_has_white_noise_of_the_declared_deviation_about_each_axis():
    sim = simulation(gyroscope(noise=0.02))
    readings = turned(sim, 2000)
    assert readings.std(axis=0) == pytest.approx([0.02] * 3, rel=0.06)
    assert np.abs(readings.mean(axis=0)).max() < 4 * 0.02 / np.sqrt(2000)
    one_later = np.mean(readings[1:] * readings[:-1], axis=0) / readings.var(axis=0)
    assert np.abs(one_later).max() < 4 / np.sqrt(2000)


def test_the_packet_tells_its_noise_as_covariance():
    sim = simulation(gyroscope(noise=0.02))
    sim.step_to_next()
    covariance = np.reshape(sim.read("out0").angular_velocity_covariance, (3, 3))
    assert covariance == pytest.approx(0.0004 * np.eye(3))


@pytest.mark.parametrize("rate", [20, 100])
def test_a_bias_walks_from_zero_as_far_in_a_second_whatever_the_rate(rate):
    walk = turned(simulation(gyroscope(rate=rate, bias_drift=0.01)), 2000)
    steps = np.diff(walk, axis=0, prepend=0.0)
    assert steps.std(axis=0) * np.sqrt(rate) == pytest.approx([0.01] * 3, rel=0.06)
    one_later = np.mean(steps[1:] * steps[:-1], axis=0) / steps.var(axis=0)
    assert np.abs(one_later).max() < 4 / np.sqrt(2000)


def test_noise_is_added_to_what_is_measured_and_changes_no_physics():
    runs = []
    for keys in ({}, {"noise": 0.02}):
        sim = simulation(gyroscope(**keys))
        sim.actuate("turn_speed", 1.5)
        runs.append((turned(sim, 100)[-1, 2], sim.data.qpos.tobytes()))
    (clean, at), (noisy, noisy_at) = runs
    assert at == noisy_at
    assert 0 < abs(noisy - clean) < 0.1


@pytest.mark.needs("OpenGL")
@pytest.mark.parametrize("type_", [IMAGE, "uint8[48,64,3]"])
def test_a_camera_has_noise_of_each_colour_of_each_pixel(type_):
    size = {"width": 64, "height": 48}
    outputs = [
        (type_, {"sensor": "camera", "element": "eye", "rate": 10, **size, **keys})
        for keys in ({}, {"noise": 8.0})
    ]
    sim = simulation(*outputs)
    differences = []
    for _ in range(3):
        sim.step_to_next()
        clean, noisy = (sim.read(name) for name in ("out0", "out1"))
        pair = [clean, noisy]
        if type_ == IMAGE:
            pair = [np.frombuffer(each.data, np.uint8).reshape(48, 64, 3) for each in pair]
        between = (pair[0] > 40) & (pair[0] < 215)  # where nothing is cut off
        differences.append(pair[1][between].astype(float) - pair[0][between])
    assert len(differences[0]) > 500
    assert np.std(differences) == pytest.approx(8.0, rel=0.06)
    assert abs(np.mean(differences)) < 0.5
    assert abs(np.corrcoef(differences[0], differences[1])[0, 1]) < 0.1
    assert abs(np.corrcoef(differences[0][1:], differences[0][:-1])[0, 1]) < 0.1


def test_two_sensors_of_one_element_differ():
    sim = simulation(gyroscope(noise=0.02), gyroscope(noise=0.02))
    sim.step_to_next()
    first, second = (sim.read(name).angular_velocity.z for name in ("out0", "out1"))
    assert first != second


def test_the_noise_of_a_sensor_does_not_depend_on_the_other_ones():
    alone = turned(simulation(gyroscope(noise=0.02, bias_drift=0.1)), 10)
    others = [gyroscope(noise=0.1, rate=50)]
    sim = simulation(gyroscope(noise=0.02, bias_drift=0.1), *others)
    found = []
    for _ in range(10):
        found.append(turned(sim, 1)[0])
        sim.read("out1")
    assert np.array_equal(alone, found)


def test_a_reset_begins_the_noise_anew():
    sim = simulation(gyroscope(noise=0.02, bias_drift=0.1))
    before = turned(sim, 20)
    sim.reset()
    assert np.array_equal(turned(sim, 20), before)


def test_noise_goes_on_when_entities_come_and_go(tmp_path):
    (tmp_path / "cup.xml").write_text(CUP, "utf-8")
    expected = turned(simulation(gyroscope(noise=0.02, bias_drift=0.1)), 30)
    node = SimulatedNode({"out0": gyroscope(noise=0.02, bias_drift=0.1)}, None, tmp_path, SEED)
    sim = MuJoCo(node, WORLD)
    found = [turned(sim, 10)]
    sim.spawn_entity("cup.xml", (0, 0, 0), "cup")
    found.append(turned(sim, 10))
    sim.remove_entity("cup")
    found.append(turned(sim, 10))
    assert np.concatenate(found) == pytest.approx(expected, abs=1e-12)


def project(folder: Path, environment=SEED, **keys) -> Path:
    """A node that sends what its gyroscope measures."""
    (folder / "world.xml").write_text(WORLD, "utf-8")
    (folder / "plugin.py").write_text(PLUGIN, "utf-8")
    type_, sensor = gyroscope(**keys)
    node = {"name": "robot", "plugin": "plugin.py", "container": "neuros_mujoco"}
    node |= {"outputs": [{"name": "imu", "type": type_, "mujoco": sensor}]}
    text = json.dumps({"nodes": [{**node, "environment": environment}]})
    (folder / "project.json").write_text(text, "utf-8")
    return folder


def episode(session, rounds=10):
    """What the gyroscope sends about the vertical axis."""
    found = []
    for _ in range(rounds):
        session.step(timeout_s=DEADLINE_S)
        found.append(session["robot.imu"].packet.angular_velocity.z)
    return found


@pytest.mark.parametrize("backend", ["local", "in-process", "process"])
def test_one_seed_gives_one_noise_and_another_seed_another(tmp_path, backend):
    """In a new run, and in an episode after a reset, in place or by a new start."""
    made = neuros.Project.from_file(project(tmp_path, noise=0.02, bias_drift=0.1))
    with made.session(backend=backend, seed=3) as session:
        first = episode(session)
        session.reset(seed=4)
        other = episode(session)
        session.reset(seed=3)
        again = episode(session)
    assert first == again
    assert not set(first) & set(other)
    with made.session(backend="local", seed=3) as session:
        assert episode(session) == first


@pytest.mark.parametrize(
    ("keys", "environment", "problem"),
    [
        ({"noise": -1}, SEED, "/mujoco/noise: must be at least 0, but is -1"),
        ({"noise": "0.1"}, SEED, "/mujoco/noise: must be a number"),
        ({"bias_drift": 0.1}, {}, "/mujoco/bias_drift: noise needs a seed: one variable with SEED"),
        ({"noise": 0.1}, {"SEED": "1", "RNG_SEED": "2"}, "of node 'robot', which has several"),
        ({"nois": 0.1}, SEED, "did you mean 'noise'?"),
    ],
)
def test_faults_are_found_before_the_start(tmp_path, keys, environment, problem):
    with pytest.raises(ProjectError) as caught:
        neuros.Project.from_file(project(tmp_path, environment, **keys)).validate()
    assert problem in str(caught.value)


def test_noise_of_zero_needs_no_seed(tmp_path):
    neuros.Project.from_file(project(tmp_path, {}, noise=0)).validate()


def test_other_sensors_have_no_noise():
    with pytest.raises(ModelError, match=r"/outputs/0/mujoco/noise: unknown key"):
        simulation(
            ("geometry_msgs/msg/Pose", {"sensor": "pose", "element": "box", "rate": 1, "noise": 1})
        )
