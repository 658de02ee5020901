"""Cycles of a run with and without NeuROS in turn: the slices, and the sums."""

from __future__ import annotations

import random
import runpy
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import cycles
from benchmarks.cycles import APART, HAND, LOOP, NEUROS, relative_costs, slice_of
from neuros.hooks import HookKind, HookSpec


@pytest.fixture(scope="module")
def by_hand() -> Any:
    """What the Python of the nodes imports."""
    return SimpleNamespace(**runpy.run_path(str(cycles.BY_HAND / "sitecustomize.py")))


def test_a_slice_is_a_line() -> None:
    assert slice_of("1800000 by hand") == ("by hand", 1_800_000)


def test_costs_are_shares_of_what_neuros_costs_about_the_same_time() -> None:
    slices = []
    for pace in (10, 20, 40):  # the machine grows slower
        slices += [(NEUROS, 100 * pace), (HAND, 90 * pace), (LOOP, 80 * pace)] * 30
    costs = relative_costs(slices)
    assert costs[NEUROS] == pytest.approx(1.0, abs=0.02)
    assert costs[HAND] == pytest.approx(0.9, abs=0.02)
    assert costs[LOOP] == pytest.approx(0.8, abs=0.02)


def test_a_slice_that_something_has_held_up_counts_for_nothing() -> None:
    slices = [(NEUROS, 100), (LOOP, 80)] * 20
    assert relative_costs([*slices, (LOOP, 10_000)])[LOOP] == pytest.approx(0.8)


def test_a_run_that_is_too_short_is_an_error() -> None:
    with pytest.raises(RuntimeError, match="only 1 slices"):
        relative_costs([(NEUROS, 100)])


def test_each_mode_has_its_turn(by_hand: Any) -> None:
    assert sorted(by_hand.random_order(random.Random(3))) == sorted((NEUROS, HAND, APART, LOOP))


def test_hooks_are_counted_and_otherwise_left_as_they_are(by_hand: Any, tmp_path: Any) -> None:
    def start(node: Any) -> str:
        return f"started {node}"

    def simulate(node: Any) -> str:
        return f"simulated {node}"

    def keep_truth(node: Any, packet: Any) -> None: ...

    counted = by_hand.Cycles(tmp_path / "cycles")
    specs = counted.add(
        "robot",
        [
            HookSpec(HookKind.INITIALISE, start),
            HookSpec(HookKind.FUNCTION, simulate),
            HookSpec(HookKind.FUNCTION, keep_truth),
        ],
    )
    assert [spec.name for spec in specs] == ["start", "simulate", "keep_truth"]
    assert specs[0].function("robot") == "started robot"
    assert [specs[1].function("robot") for _ in range(3)] == ["simulated robot"] * 3
    assert specs[2].function is keep_truth
    assert not (tmp_path / "cycles").exists()  # it has still to settle
