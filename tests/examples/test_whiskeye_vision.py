"""The benchmark of vision: rooms by seed, decoders, gates and drives, at a small size."""

from __future__ import annotations

import importlib
import math
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples/4_neurorobotics/whiskeye"


@pytest.fixture(scope="module")
def modules():
    """The benchmark and its decoders, as their own script imports them."""
    pytest.importorskip("mujoco")
    before = set(sys.modules)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLE)
        names = ("vision_benchmark", "decoders", "rooms", "predictive_coding", "views")
        yield {name: importlib.import_module(name) for name in names}
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(EXAMPLE)):
            del sys.modules[name]


@pytest.fixture(scope="module")
def rows(modules):
    """What the benchmark finds in one room, with a third of the views and a drive of 24 s."""
    small = {"LEARNT": 260, "VALIDATED": 60, "TESTED": 40, "DRIVE_S": 24.0, "KIDNAPPED_S": 8.0}
    small |= {"DARK_S": (14.0, 16.0), "NOISY_S": (18.0, 20.0)}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in small.items():
            patch.setattr(modules["vision_benchmark"], name, value)
        patch.setattr(modules["decoders"], "EPOCHS", 8)
        return modules["vision_benchmark"].study(1)


def figure(rows, figure, method, condition="headings", gate="bump"):
    (found,) = [
        row[figure]
        for row in rows["views"]
        if (row["method"], row["condition"], row["gate"]) == (method, condition, gate)
    ]
    return found


@pytest.mark.needs("OpenGL")
class TestOneRoom:
    def test_raw_pixels_beat_predictive_coding_at_held_out_headings(self, rows):
        pixels = figure(rows, "rms_deg", "pixels")
        assert pixels < 5
        assert figure(rows, "rms_deg", "predictive coding") > 1.1 * pixels

    def test_the_gate_lets_views_of_the_disc_pass_and_few_from_outside_of_it(self, rows):
        own = {"method": "predictive coding", "gate": "view"}
        assert figure(rows, "passed", condition="validation", **own) == pytest.approx(
            0.95, abs=0.02
        )
        assert figure(rows, "passed", condition="places", **own) > 0.7
        assert figure(rows, "passed", condition="outside", **own) < 0.4
        assert figure(rows, "passed", condition="occluded", **own) < 0.1

    def test_each_method_and_gate_has_a_row_for_each_condition_and_drive(self, rows, modules):
        pairs = {(row["method"], row["gate"]) for row in rows["views"]}
        assert len(pairs) == 5 + 3 + 1
        assert len(rows["views"]) == len(pairs) * (1 + len(modules["vision_benchmark"].CONDITIONS))
        drives = {(row["method"], row["gate"]) for row in rows["drives"]}
        assert drives == {("gyroscope alone", ""), *pairs} - {("predictive coding", "view 0.12")}

    def test_a_drive_with_vision_is_better_than_the_gyroscope_alone(self, rows):
        of = {(row["method"], row["gate"]): row["rms_deg"] for row in rows["drives"]}
        alone = of.pop(("gyroscope alone", ""))
        assert all(rms_deg < alone for rms_deg in of.values())

    def test_tables_and_figure_are_made_of_the_rows(self, rows, modules, tmp_path):
        benchmark = modules["vision_benchmark"]
        benchmark.write(rows, tmp_path)
        benchmark.draw(rows, tmp_path / "figure.png")
        text = (tmp_path / "table.md").read_text()
        pixels = figure(rows, "rms_deg", "pixels")
        assert f"| headings | {pixels:.1f} ({pixels:.1f} to {pixels:.1f}) |" in text
        names = {each.name for each in tmp_path.iterdir()}
        assert names == {"views.csv", "coverage.csv", "drives.csv", "table.md", "figure.png"}


@pytest.mark.needs("OpenGL")
def test_a_seed_gives_a_room_and_another_seed_another(modules):
    pictures = []
    for seed in (1, 1, 2):
        eyes = modules["rooms"].Eyes(modules["rooms"].room(seed))
        pictures.append(eyes.see(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])))
        eyes.close()
    assert pictures[0].shape == (2, modules["views"].PIXELS)
    assert np.array_equal(pictures[0], pictures[1])
    different = np.abs(pictures[0] - pictures[2]).mean()
    assert different > 10
    assert np.abs(pictures[0][0] - pictures[0][1]).mean() > 10


def test_views_are_drawn_from_the_part_that_they_are_called_by(modules):
    from_part = modules["vision_benchmark"].poses
    rng = np.random.default_rng(1)
    learnt = from_part(rng, 200)
    assert np.all(np.degrees(learnt[:, 2]) % 24 >= 4)
    assert np.all(np.degrees(from_part(rng, 50, "headings")[:, 2]) % 24 < 4)
    away_m = np.linalg.norm(from_part(rng, 50, radius_m=(1.2, 1.8))[:, :2], axis=1)
    assert 1.2 <= away_m.min() < away_m.max() <= 1.8


def test_the_cnn_descends_the_error_of_its_codes(modules, monkeypatch):
    """Its rises are those of the negative error, by finite differences."""
    monkeypatch.setattr(modules["decoders"], "EPOCHS", 2)
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(48, 1152)).astype(np.float32)
    codes = rng.random((48, 180)).astype(np.float32)
    network = modules["decoders"].SmallCNN(seen, codes, 1)
    network._weights = [each.astype(np.float64) for each in network._weights]
    seen = seen.astype(np.float64)

    def height():
        cells = network._forward(seen)[-1]
        missed = codes - cells @ network._weights[-2] - network._weights[-1]
        return -0.5 * np.sum(np.square(missed)) / len(seen)

    for weights, rise in zip(network._weights, network._rises(seen, codes), strict=True):
        at = tuple(rng.integers(size) for size in weights.shape)
        weights[at] += 1e-5
        above = height()
        weights[at] -= 2e-5
        assert (above - height()) / 2e-5 == pytest.approx(rise[at], rel=1e-4, abs=1e-7)
        weights[at] += 1e-5


class TestFilter:
    @pytest.fixture
    def ring(self, modules):
        return modules["vision_benchmark"].HeadingFilter()

    def test_it_turns_as_far_as_the_gyroscope_says(self, ring):
        for _ in range(10):
            ring.turn(0.35, 0.01)
        assert ring.heading_rad == pytest.approx(math.remainder(3.5, math.tau), abs=0.02)

    def test_it_weighs_what_is_seen_by_how_exact_it_is(self, ring):
        ring.turn(0.0, 0.1)
        ring.see(0.2, 0.1)
        assert ring.heading_rad == pytest.approx(0.1, abs=0.02)

    def test_one_wrong_view_does_not_carry_it_away_and_a_kidnapping_does(self, ring):
        for _ in range(5):
            ring.turn(0.0, 0.03)
            ring.see(0.0, 0.03)
        ring.turn(0.0, 0.03)
        ring.see(2.5, 0.03)
        once = abs(ring.heading_rad)
        for _ in range(3):
            ring.turn(0.0, 0.03)
            ring.see(2.5, 0.03)
        assert once < 1.0
        assert ring.heading_rad == pytest.approx(2.5, abs=0.05)


def test_an_interval_is_of_seeds(modules):
    mean, low, high = modules["vision_benchmark"].interval([1.0, 2.0, 3.0, math.nan])
    assert low < mean == 2.0 < high
    assert modules["vision_benchmark"].interval([4.0, 4.0]) == (4.0, 4.0, 4.0)
