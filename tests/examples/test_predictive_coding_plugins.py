"""What the nodes of predictive_coding do without TensorFlow, which is not in this environment.

The whole of it, with the network, is in ``tests/acceptance``.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from launching import launch
from sensor_msgs.msg import Image

from neuros.testing import PluginHarness

EXAMPLE = Path(__file__).parents[2] / "examples/4_neurorobotics/predictive_coding"


@pytest.fixture
def view(load):
    return load("view")


def picture(seed: int, light: float = 1.0) -> Image:
    """80 x 60 pixels of any colours."""
    pixels = light * np.random.default_rng(seed).uniform(0, 255, (60, 80, 3))
    image = Image(width=80, height=60, encoding="rgb8", step=240)
    image.data = np.round(pixels).astype(np.uint8).tobytes()
    return image


def turned_by(yaw_rad: float, nanosec: int = 0) -> PoseStamped:
    pose = PoseStamped()
    pose.header.stamp.nanosec = nanosec
    pose.pose.orientation.z, pose.pose.orientation.w = math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)
    return pose


def test_a_picture_becomes_numbers_that_do_not_depend_on_the_light(view):
    pixels = view.pixels_of(picture(1))
    assert pixels.shape == (view.PIXELS,) == (900,)
    assert pixels.dtype == np.float32
    assert pixels.mean() == pytest.approx(0.0, abs=1e-6)
    assert pixels.std() == pytest.approx(1.0, abs=1e-4)
    assert np.allclose(view.pixels_of(picture(1, light=0.5)), pixels, atol=0.05)
    assert not np.allclose(view.pixels_of(picture(2)), pixels, atol=0.5)


def test_a_picture_is_averaged_over_blocks_in_place(view):
    expected = np.arange(300).reshape(15, 20) % 256
    grey = np.kron(expected, np.ones((4, 4)))
    image = picture(1)
    image.data = np.repeat(grey, 3).astype(np.uint8).tobytes()
    found = view.pixels_of(image).reshape(15, 20, 3)
    assert np.allclose(found[..., 0], (expected - expected.mean()) / expected.std(), atol=1e-4)


@pytest.mark.parametrize("heading_rad", np.linspace(-3.1, 3.1, 9))
def test_a_heading_becomes_a_code_and_the_heading_again(view, heading_rad):
    code = view.code_of(heading_rad)
    assert code.shape == (view.CODES,)
    assert view.heading_of(code) == pytest.approx(heading_rad, abs=1e-5)
    assert view.yaw_of(turned_by(heading_rad).pose.orientation) == pytest.approx(heading_rad)


def test_an_arena_is_a_function_of_its_seed(load):
    arena = load("arena").arena
    assert arena(1) == arena(1) != arena(2)
    assert arena(1).count("<geom") == 24 + 2


@pytest.mark.needs("OpenGL")
def test_the_robot_tells_its_heading_while_the_network_is_to_learn_and_never_after(view):
    pytest.importorskip("mujoco")
    with PluginHarness.from_project(
        EXAMPLE, "robot", environment={"LEARN_S": "0.3", "TEST_S": "0.2"}
    ) as robot:
        robot.run(40)
        packets = {name: robot.received(name) for name in ("example", "label", "view", "pose")}
        assert {name: len(found) for name, found in packets.items()} == {
            "example": 6,
            "label": 6,
            "view": 4,
            "pose": 4,
        }
        assert robot.shutdown_reason == "0.5 s simulated"
    for pictures, poses in (("example", "label"), ("view", "pose")):
        stamps = [[each.header.stamp for each in packets[name]] for name in (pictures, poses)]
        assert stamps[0] == stamps[1]
    seen = [view.pixels_of(each) for each in packets["example"]]
    assert not np.allclose(seen[0], seen[-1], atol=0.1)


def test_the_judge_compares_what_belongs_together(tmp_path, view):
    with PluginHarness.from_project(EXAMPLE, "judge", run_folder=tmp_path) as judge:
        for count, (true_rad, off_deg) in enumerate([(3.1, 6.0), (-3.1, -8.0), (0.0, 0.0)]):
            estimate = Vector3Stamped()
            estimate.header.stamp.nanosec = count
            estimate.vector.z = math.remainder(true_rad + math.radians(off_deg), math.tau)
            estimate.vector.x = 0.5
            judge.send("truth", turned_by(true_rad, count))
            judge.send("estimate", estimate)
            judge.run()
        judge.finalise()
        found = json.loads((judge.run_dir / "heading.json").read_text())
        assert json.loads((judge.run_dir / "results.json").read_text()) == found
    assert found["views"] == 3
    assert found["rms_deg"] == pytest.approx(math.sqrt(100 / 3))
    assert found["median_deg"] == pytest.approx(6.0)
    assert found["max_deg"] == pytest.approx(8.0)
    assert found["image_error"] == pytest.approx(0.5)
    # A quarter of a million headings by chance, to 5 standard errors (the square has one of 0.89).
    by_chance = np.random.default_rng(1).uniform(-180, 180, 250_000)
    assert np.sqrt(np.mean(by_chance**2)) == pytest.approx(found["chance_deg"], rel=0.005)


@pytest.mark.skipif(
    importlib.util.find_spec("tensorflow") is not None, reason="TensorFlow is in this environment"
)
def test_in_one_process_without_tensorflow_it_says_what_is_missing(tmp_path):
    run = launch(EXAMPLE, "--backend", "in-process", cwd=tmp_path)
    assert run.exit_code == 4
    assert "container 'neuros_tensorflow' (node brain) needs tensorflow-cpu" in run.output
    assert "use --backend process" in run.output
