"""How WhiskEye's ring is corrected by what its eyes see: target, gate, current, and the nodes."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from sensor_msgs.msg import Image

from neuros.errors import NodeError
from neuros.testing import PluginHarness

EXAMPLE = Path(__file__).parents[2] / "examples/4_neurorobotics/whiskeye"
PERIOD_NS = 20_000_000
EXACT = math.radians(1.0)  # a heading as exact as this counts fully


class TestSeenHeading:
    """The heading that the correction pulls to, and how much it counts."""

    @pytest.fixture
    def correction(self, load):
        pytest.importorskip("nest")
        return load("correction")

    @pytest.fixture
    def seen(self, correction):
        """Ten periods after the start, at 0.5 rad/s."""
        seen = correction.SeenHeading(gate=0.1)
        for index in range(1, 11):
            seen.turn(index * PERIOD_NS, 0.5)
        return seen

    def test_without_a_picture_there_is_no_target(self, seen):
        assert seen.now() is None

    def test_what_was_seen_is_turned_with_the_gyroscope(self, seen):
        seen.see(5 * PERIOD_NS, 1.0, 0.05, EXACT)
        assert seen.now() == pytest.approx((1.0 + 0.5 * 0.1, 1.0))

    @pytest.mark.parametrize(
        ("deviations", "weight"), [(0.1, 1.0), (1.0, 1.0), (2.0, 0.25), (3, 1 / 9)]
    )
    def test_it_counts_by_the_inverse_of_its_variance(self, seen, deviations, weight):
        seen.see(10 * PERIOD_NS, 1.0, 0.05, deviations * EXACT)
        assert seen.now() == pytest.approx((1.0, weight))

    def test_between_two_pictures_the_last_one_counts(self, seen):
        seen.see(10 * PERIOD_NS, 1.0, 0.05, EXACT)
        seen.turn(11 * PERIOD_NS, 0.5)
        seen.see(11 * PERIOD_NS, math.nan, math.inf, 0.0)
        assert seen.now() == pytest.approx((1.01, 1.0))

    def test_a_view_that_is_not_predicted_ends_the_correction(self, seen):
        seen.see(9 * PERIOD_NS, 1.0, 0.05, EXACT)
        seen.see(10 * PERIOD_NS, 1.0, 0.11, EXACT)
        assert seen.now() is None

    def test_what_is_too_old_corrects_nothing(self, correction, seen):
        seen.see(10 * PERIOD_NS, 1.0, 0.05, EXACT)
        periods = correction.HOLD_NS // PERIOD_NS
        for index in range(11, 11 + periods):
            seen.turn(index * PERIOD_NS, 0.0)
        assert seen.now() == pytest.approx((1.0, 1.0))
        seen.turn((11 + periods) * PERIOD_NS, 0.0)
        assert seen.now() is None


class TestRings:
    """Two rings in one kernel."""

    @pytest.fixture
    def head_direction(self, load):
        pytest.importorskip("nest")
        return load("head_direction")

    @staticmethod
    def pair(head_direction):
        alone = head_direction.HeadDirectionNetwork(seed=1)
        beside = head_direction.HeadDirectionNetwork(seed=1, beside=alone)
        alone.settle()
        return alone, beside

    def test_uncorrected_both_are_what_one_is_by_itself_bit_for_bit(self, head_direction):
        single = head_direction.HeadDirectionNetwork(seed=1)
        single.settle()
        expected = [single.step(1.0, 0.02) for _ in range(25)]
        alone, beside = self.pair(head_direction)
        told = []
        for _ in range(25):
            alone.step(1.0, 0.02)
            told.append((alone.heading_rad, beside.heading_rad))
        assert told == [(each, each) for each in expected]

    def test_the_activity_of_each_ring_is_a_bump_at_its_heading(self, head_direction):
        alone, beside = self.pair(head_direction)
        at_zero = np.zeros(head_direction.NEURONS_PER_RING, int)
        for _ in range(25):
            alone.step(0.0, 0.02)
            at_zero += alone.activity
        assert alone.activity.shape == at_zero.shape
        beside.correct(math.radians(90), 300.0, math.radians(30))
        for _ in range(100):
            alone.step(0.0, 0.02)
        turned = np.zeros_like(at_zero)
        for _ in range(25):
            alone.step(0.0, 0.02)
            turned += beside.activity
        moved = math.remainder(direction_rad(turned) - direction_rad(at_zero), math.tau)
        assert math.degrees(moved) == pytest.approx(90, abs=8)

    def test_a_correction_pulls_the_bump_of_that_ring_alone(self, head_direction):
        alone, beside = self.pair(head_direction)
        beside.correct(math.radians(30), 120.0, math.radians(30))
        for _ in range(50):
            alone.step(0.0, 0.02)
        assert math.degrees(alone.heading_rad) == pytest.approx(0, abs=6)
        assert math.degrees(beside.heading_rad) == pytest.approx(30, abs=6)
        beside.correct(0.0, 0.0, 1.0)
        for _ in range(25):
            alone.step(0.0, 0.02)
        assert math.degrees(beside.heading_rad) == pytest.approx(30, abs=8)


def direction_rad(activity):
    """Of the population vector."""
    phases = np.linspace(0.0, math.tau, activity.size, endpoint=False)
    return float(np.angle(np.sum(activity * np.exp(1j * phases))))


def test_a_biased_gyroscope_is_corrected_and_the_ring_alone_drifts(load):
    pytest.importorskip("nest")
    integrator = load("correction").CorrectedIntegrator(
        seed=1, bias_rad_s=0.3, peak_pa=300.0, gate=0.3
    )
    corrected, alone = look_ahead(integrator, seconds=3)
    assert math.degrees(alone) == pytest.approx(math.degrees(0.9), abs=8)
    assert abs(math.degrees(corrected)) < 15


def look_ahead(integrator, seconds):
    """Stand still, and see it exactly at 10 Hz; the last headings."""
    for index in range(1, 50 * seconds + 1):
        if index % 5 == 0:
            integrator.vision.see(index * PERIOD_NS, 0.0, 0.01, EXACT)
        headings = integrator.integrate(index * PERIOD_NS, 0.0)
    return headings


class TestWrongStart:
    """A ring that starts somewhere else finds the heading that is seen."""

    @pytest.fixture
    def wrong_start(self, load):
        pytest.importorskip("nest")
        return load("wrong_start")

    @pytest.mark.parametrize(
        ("start_deg", "rate_rad_s"), [(180.0, 0.0), (180.0, 1.0), (-150.0, 1.0)]
    )
    def test_it_is_right_within_seconds_and_stays_so(self, wrong_start, start_deg, rate_rad_s):
        errors = wrong_start.errors_deg(start_deg, rate_rad_s, seed=2)
        assert abs(errors[0]) > 120
        assert wrong_start.found_after_s(errors) < 4.0

    def test_a_current_that_does_not_insist_leaves_it_there(self, wrong_start):
        errors = wrong_start.errors_deg(180.0, 0.0, seed=2, insisting=0.0)
        assert wrong_start.found_after_s(errors) is None
        assert np.min(np.abs(errors)) > 150

    def test_views_that_are_wrong_for_a_moment_do_not_carry_it_away(self, load):
        integrator = load("correction").CorrectedIntegrator(1, 0.0, 300.0, 0.3)
        look_ahead(integrator, seconds=1)
        for index in range(51, 151):
            if index % 5 == 0:
                wrong = math.pi if index < 66 else 0.0
                integrator.vision.see(index * PERIOD_NS, wrong, 0.01, EXACT)
            corrected, _ = integrator.integrate(index * PERIOD_NS, 0.0)
            assert abs(math.degrees(corrected)) < 15

    def test_it_takes_no_bias_of_the_gyroscope_from_a_wrong_start(self, load):
        integrator = load("correction").CorrectedIntegrator(
            1, 0.0, 300.0, 0.3, learning_per_s2=0.2, start_rad=math.pi
        )
        look_ahead(integrator, seconds=3)
        assert integrator.learnt_rad_s == pytest.approx(0.0, abs=1e-3)

    def test_a_mismatch_is_believed_after_a_second_and_later_where_headings_are_less_exact(
        self, load
    ):
        believed = []
        for weight in (1.0, 0.25):
            mismatch = load("correction").Mismatch()
            for _ in range(50):
                mismatch.see(math.pi, weight, 0.02)
            believed.append(mismatch.mean)
        assert believed == pytest.approx([1 - math.exp(-1), 1 - math.exp(-0.25)])


@pytest.mark.acceptance
def test_the_bias_of_the_gyroscope_is_learnt_from_what_it_and_vision_differ_by(load):
    pytest.importorskip("nest")
    integrator = load("correction").CorrectedIntegrator(1, -0.1, 300.0, 0.3, learning_per_s2=1.0)
    corrected, alone = look_ahead(integrator, seconds=15)
    assert integrator.learnt_rad_s == pytest.approx(-0.1, rel=0.1)
    assert abs(math.degrees(corrected)) < 6
    assert math.degrees(alone) < -60


def picture(stamp: int, *, empty: bool = False) -> Image:
    image = Image()
    image.header.stamp.nanosec = stamp
    if not empty:
        pixels = np.random.default_rng(stamp).integers(0, 255, 60 * 80 * 3, dtype=np.uint8)
        image.width, image.height, image.encoding, image.step = 80, 60, "rgb8", 240
        image.data = pixels.tobytes()
    return image


@pytest.fixture
def weights(load):
    """Of a network that has learnt next to nothing."""
    views = load("views")
    rng = np.random.default_rng(1)
    network = load("predictive_coding").PredictiveCodingNetwork(views.PIXELS, views.CODES, 1)
    seen = rng.normal(size=(24, views.PIXELS)).astype(np.float32)
    list(network.learn(seen, np.array([views.code_of(each) for each in range(24)]), 1))
    headings = rng.uniform(-3, 3, 24)
    return {
        **network.weights,
        "rad_per_error": 0.5,
        "old_views": seen.astype(np.float16),
        "old_rad": headings.astype(np.float32),
        "test_views": seen.astype(np.float16),
        "test_rad": headings.astype(np.float32),
    }


def test_the_network_answers_each_pair_of_pictures_and_says_where_there_was_none(weights):
    with PluginHarness.from_project(
        EXAMPLE / "prediction.json", "pcn", restore={"weights": weights}
    ) as pcn:
        for stamp, empty in ((1, True), (2, False)):
            for eye in ("left_eye", "right_eye"):
                pcn.send(eye, picture(stamp, empty=empty))
        pcn.run()
        nothing, seen = pcn.received("odom_correction", "snn")
        (error,) = pcn.received("prediction_error")
        (view,) = pcn.received("predicted_view")
    assert math.isnan(nothing.vector.z)
    assert nothing.vector.x == math.inf
    assert (nothing.header.stamp.nanosec, seen.header.stamp.nanosec) == (1, 2)
    assert error.vector.x == seen.vector.x > 0
    assert seen.vector.y == pytest.approx(0.5 * seen.vector.x)
    assert abs(seen.vector.z) <= math.pi
    assert (view.header.stamp.nanosec, view.height, view.width, view.step) == (2, 60, 160, 480)
    assert len(view.data) == view.height * view.step
    assert np.std(view.data) > 1


def test_views_that_are_not_predicted_are_learnt_with_the_heading_of_the_ring(weights):
    """The heading of a view comes with the next pictures, as in the project."""
    environment = {"GATE": "0", "NEW_VIEWS": "8", "EPOCHS": "12"}
    project, restore = EXAMPLE / "learning.json", {"weights": weights}
    with PluginHarness.from_project(
        project, "pcn", environment=environment, restore=restore
    ) as pcn:
        for stamp in range(1, 11):
            for eye in ("left_eye", "right_eye"):
                pcn.send(eye, picture(stamp))
            heading = Vector3Stamped()
            heading.header.stamp.nanosec, heading.vector.z = stamp - 1, 0.3 * (stamp - 1)
            pcn.send("heading", heading)
        pcn.run()
        before, *_, after = (each.vector.x for each in pcn.received("prediction_error"))
        (found,) = json.loads((pcn.run_dir / "learning.json").read_text())
        kept = pcn.kept["weights"]
    assert found["learnt"] == 6
    assert len(kept["old_rad"]) == len(kept["old_views"]) == len(weights["old_rad"]) + 6
    assert not np.array_equal(kept["down0"], weights["down0"])
    again = PluginHarness.from_project(project, "pcn", restore={"weights": kept})
    again.run()
    assert np.array_equal(again.kept["weights"]["down0"], kept["down0"])
    assert found["after"]["old"]["view_error"] < found["before"]["old"]["view_error"]
    assert found["after"] != found["before"]
    assert after != before


def test_pictures_of_two_eyes_are_paired_where_some_are_lost(load):
    eyes = load("pcn").Eyes()
    left, right = ({n: picture(n) for n in range(1, 6)} for _ in range(2))
    assert eyes.pairs(left[1], right[1]) == [(left[1], right[1])]
    assert eyes.pairs(left[2], right[3]) == []
    assert eyes.pairs(left[3], right[4]) == [(left[3], right[3])]
    assert eyes.pairs(left[4], right[5]) == [(left[4], right[4])]


@pytest.mark.parametrize("project", ["prediction.json", "learning.json"])
def test_without_weights_it_says_how_to_get_them(project):
    with (
        PluginHarness.from_project(EXAMPLE / project, "pcn") as pcn,
        pytest.raises(NodeError, match=r"train it with training\.json"),
    ):
        pcn.run()


def test_the_visualiser_tells_the_error_of_each_and_keeps_all_series(tmp_path):
    with PluginHarness.from_project(
        EXAMPLE / "prediction.json", "visualiser", run_folder=tmp_path
    ) as visualiser:
        for stamp in range(1, 4):
            pose = PoseStamped()
            pose.header.stamp.nanosec, pose.pose.orientation.w = stamp, 1.0
            visualiser.send("truth", pose)
            for name, off_deg in (("uncorrected", 20.0), ("vision", -3.0), ("corrected", 2.0)):
                packet = Vector3Stamped()
                packet.header.stamp.nanosec, packet.vector.z = stamp, math.radians(off_deg)
                if (name, stamp) == ("vision", 2):
                    packet.vector.z = math.nan
                visualiser.send(name, packet)
        visualiser.run()
        visualiser.finalise()
        folder = visualiser.run_dir
    found = json.loads((folder / "correction.json").read_text())
    assert {name: round(each["rms_deg"], 6) for name, each in found.items()} == {
        "uncorrected": 20.0,
        "vision": 3.0,
        "corrected": 2.0,
    }
    assert found["vision"]["samples"] == 2
    with (folder / "correction.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["vision_rad"] for row in rows] == [
        repr(math.radians(-3.0)),
        "",
        rows[0]["vision_rad"],
    ]
