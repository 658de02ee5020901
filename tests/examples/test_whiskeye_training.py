"""The network that learns WhiskEye's views: alone, beside its baselines, and as a node."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from sensor_msgs.msg import Image

from neuros.testing import PluginHarness

EXAMPLE = Path(__file__).parents[2] / "examples/4_neurorobotics/whiskeye"
VIEWS = 120


def picture(heading_rad: float, light: float = 1.0) -> Image:
    """80 x 60 pixels of a panorama that is seen in this direction."""
    columns = heading_rad + np.linspace(-0.8, 0.8, 80)
    waves = [np.sin(count * columns + count**2) for count in (1, 2, 3)]
    pixels = light * (127 + 100 * np.stack(waves, axis=-1)) * np.ones((60, 1, 1))
    image = Image(width=80, height=60, encoding="rgb8", step=240)
    image.data = np.round(pixels).astype(np.uint8).tobytes()
    return image


def label(heading_rad: float, x_m: float = 0.0, y_m: float = 0.0) -> PoseStamped:
    pose = PoseStamped()
    pose.pose.orientation.z = math.sin(heading_rad / 2)
    pose.pose.orientation.w = math.cos(heading_rad / 2)
    pose.pose.position.x, pose.pose.position.y = x_m, y_m
    return pose


@pytest.fixture
def examples(load):
    """Headings all around, their views and their codes."""
    views = load("views")
    headings = np.linspace(-np.pi, np.pi, VIEWS, endpoint=False)
    seen = np.array([views.view_of(picture(each), picture(each + 0.6)) for each in headings])
    return headings, seen, np.array([views.code_of(each) for each in headings])


def off_deg(told_rad, true_rad):
    return np.abs(np.degrees(np.angle(np.exp(1j * (np.array(told_rad) - true_rad)))))


def test_a_view_does_not_depend_on_the_light(load):
    view_of = load("views").view_of
    view = view_of(picture(0.3), picture(0.9))
    assert view.shape == (load("views").PIXELS,) == (1152,)
    assert view.mean() == pytest.approx(0.0, abs=1e-6)
    assert np.allclose(view_of(picture(0.3, 0.5), picture(0.9, 0.5)), view, atol=0.05)
    assert not np.allclose(view_of(picture(0.9), picture(0.3)), view, atol=0.5)


def test_a_view_is_shown_as_the_pictures_of_both_eyes_that_it_was_made_of(load):
    views = load("views")
    eyes = picture(0.3), picture(0.9)
    shown = views.picture_of(views.view_of(*eyes), *eyes)
    assert shown.shape == (60, 160, 3)
    for half, eye in zip(np.hsplit(shown, 2), eyes, strict=True):
        pixels = np.frombuffer(eye.data, np.uint8).reshape(60, 80, 3)
        assert np.abs(half.astype(float) - pixels).max() < 30  # a block of pixels has one colour


def test_the_network_tells_headings_that_it_has_not_learnt_and_knows_what_it_has_not_seen(
    load, examples
):
    headings, seen, codes = examples
    network = load("predictive_coding").PredictiveCodingNetwork(seen.shape[1], codes.shape[1], 1)
    learnt = np.arange(VIEWS) % 4 != 0
    errors = list(network.learn(seen[learnt], codes[learnt], 12))
    assert errors[-1] < errors[0] / 5
    told, error, predicted = network.infer(seen[~learnt])
    missed = seen[~learnt] - predicted
    assert np.allclose(np.mean(np.square(missed), axis=1), error[:, 0], atol=1e-6)
    heading_of = load("views").heading_of
    assert off_deg([heading_of(each) for each in told], headings[~learnt]).max() < 10
    noise = np.random.default_rng(1).normal(size=seen[:5].shape).astype(np.float32)
    assert network.infer(noise)[1][:, 0].min() > 5 * error[:, 0].max()


def test_weights_carry_all_that_was_learnt_bit_for_bit(load, examples, tmp_path):
    _, seen, codes = examples
    network_class = load("predictive_coding").PredictiveCodingNetwork

    def learnt():
        network = network_class(seen.shape[1], codes.shape[1], 7)
        list(network.learn(seen[::4], codes[::4], 2))
        return network

    network = learnt()
    np.savez(tmp_path / "weights.npz", **network.weights)
    with np.load(tmp_path / "weights.npz") as weights:
        again = network_class.of_weights(weights)
    for other in (again, learnt()):
        for found, expected in zip(other.infer(seen[:9]), network.infer(seen[:9]), strict=True):
            assert np.array_equal(found, expected)


def test_the_baselines_find_what_they_can(load, examples):
    headings, seen, _ = examples
    baselines = load("baselines")
    nearest = baselines.nearest_neighbour(seen[::2], headings[::2], seen[1::2])
    assert off_deg(nearest, headings[1::2]).max() == pytest.approx(360 / VIEWS, rel=1e-3)
    linear = baselines.linear_regression(seen[::2], headings[::2], seen[1::2])
    assert off_deg(linear, headings[1::2]).max() < 3


def test_what_is_held_out_is_never_learnt(load):
    held_out = load("held_out")
    rng = np.random.default_rng(2)
    headings, places = rng.uniform(-9, 9, 4000), rng.uniform(-0.8, 0.8, (4000, 2))
    parts = held_out.split(headings, places)
    assert not np.any(parts.learnt & (parts.headings | parts.places))
    assert not np.any(parts.headings & parts.places)
    assert min(each.sum() for each in (parts.learnt, parts.headings, parts.places)) > 300
    for place in held_out.PLACES_M:
        away = np.linalg.norm(places - place, axis=1)
        assert away[parts.learnt].min() >= held_out.PLACE_RADIUS_M
        assert away[parts.places].min() < 0.05
    assert np.all(np.degrees(headings[parts.learnt]) % 24 >= 4)


def test_the_trainer_writes_weights_with_seeds_and_figures(load, tmp_path):
    environment = {"VIEWS": str(VIEWS), "EPOCHS": "20", "SEED": "3"}
    with PluginHarness.from_project(
        EXAMPLE / "training.json", "trainer", environment=environment, run_folder=tmp_path
    ) as trainer:
        for index, heading in enumerate(np.linspace(-3.1, 3.1, VIEWS + 5)):
            place = (0.4, 0.2) if index % 3 == 0 else (0.0, 0.0)
            trainer.send("left_eye", picture(heading))
            trainer.send("right_eye", picture(heading + 0.6))
            trainer.send("label", label(heading, *place))
        trainer.run()
        assert trainer.shutdown_reason == f"{VIEWS} views learnt"
        said = [record.text for record in trainer.log]
        folder = trainer.run_dir
    assert any(text.startswith("epoch 20 of 20: view error 0.") for text in said)
    figures = json.loads((folder / "training.json").read_text())
    assert (figures["seed"], figures["epochs"]) == (3, 20)
    assert sum(figures["views"].values()) < VIEWS  # of held-out headings AND places: in no group
    assert figures["views"]["places"] > 10
    for held in ("held_out_headings", "held_out_places"):
        for method in ("network", "nearest_neighbour", "linear_regression"):
            assert 0 < figures[held][method]["rms_deg"] < 20
    with np.load(folder / "weights.npz") as weights:
        assert weights["mean"].shape == (1152,)
        assert math.degrees(weights["rad_per_error"]) == pytest.approx(figures["deg_per_error"])
        assert len(weights["old_views"]) == len(weights["old_rad"]) > 0
        tested = figures["views"]["headings"] + figures["views"]["places"]
        assert len(weights["test_views"]) == len(weights["test_rad"]) == tested
    results = json.loads((folder / "results.json").read_text())
    assert results["places_network_rms_deg"] == figures["held_out_places"]["network"]["rms_deg"]


def test_what_is_in_front_of_the_room_is_explained_away_by_robust_inference_alone(load, examples):
    """Where nothing is in front, both expect to see the same."""
    _, seen, codes = examples
    network = load("predictive_coding").PredictiveCodingNetwork(seen.shape[1], codes.shape[1], 1)
    learnt = np.arange(VIEWS) % 4 != 0
    list(network.learn(seen[learnt], codes[learnt], 12))
    clean = seen[~learnt]
    hidden = clean.reshape(-1, 2, 12, 16, 3).copy()
    hidden[:, :, :, 5:9] = 3.0  # a bright bar over a quarter of each eye
    hidden = hidden.reshape(clean.shape)

    def missed(views, robust):
        _, _, expected = network.causes(views, robust=robust)
        return np.mean(np.square(clean - expected))

    assert missed(hidden, True) < missed(hidden, False) / 2
    assert missed(clean, True) < 2 * missed(clean, False)


def estimate(heading_rad: float, stamp_s: int) -> Vector3Stamped:
    told = Vector3Stamped()
    told.header.stamp.sec, told.vector.z = stamp_s, heading_rad
    return told


@pytest.mark.parametrize("late", [0, 7], ids=["in step", "the ring is late"])
def test_a_robot_learns_the_headings_that_its_ring_tells_wrong_as_they_are(tmp_path, late):
    """The network beside it, which learns the true ones, is right."""
    environment = {"VIEWS": "90", "EPOCHS": "12", "SEED": "3"}
    with PluginHarness.from_project(
        EXAMPLE / "own_labels.json", "trainer", environment=environment, run_folder=tmp_path
    ) as trainer:
        headings = np.linspace(-3.1, 3.1, 90)
        for index in range(90 + late):
            if index < 90:
                place = (0.4, 0.2) if index % 3 == 0 else (0.0, 0.0)
                pose = label(headings[index], *place)
                pose.header.stamp.sec = index
                trainer.send("left_eye", picture(headings[index]))
                trainer.send("right_eye", picture(headings[index] + 0.6))
                trainer.send("label", pose)
            if index >= late:
                trainer.send("estimate", estimate(headings[index - late] + 0.2, index - late))
        trainer.run()
        assert trainer.shutdown_reason == "90 views learnt"
        folder = trainer.run_dir
    results = json.loads((folder / "results.json").read_text())
    assert results["labels_rms_deg"] == pytest.approx(math.degrees(0.2), abs=0.01)
    assert results["places_network_rms_deg"] == pytest.approx(math.degrees(0.2), rel=0.25)
    assert results["places_truth_rms_deg"] < results["places_network_rms_deg"] / 2
