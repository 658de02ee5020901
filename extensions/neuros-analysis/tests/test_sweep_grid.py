"""The points of a sweep, and what they are called."""

from __future__ import annotations

from argparse import ArgumentTypeError

import pytest
from neuros_analysis.options import _seeds
from neuros_analysis.sweep import Point, parse_values, points_of, short_names

from neuros.errors import UsageError

RATE = "nodes.robot.environment.RATE"


def test_every_combination_is_a_point_and_the_last_changes_first() -> None:
    points = points_of({RATE: [1, 2], "budgets.wall_s": [5]}, seeds=[7, 8], repeat=2)
    assert len(points) == 8
    assert [(p.settings[RATE], p.seed, p.repeat) for p in points][:5] == [
        (1, 7, 1), (1, 7, 2), (1, 8, 1), (1, 8, 2), (2, 7, 1),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "seeds"), [("1..8", [*range(1, 9)]), ("7,1..3", [7, 1, 2, 3]), ("4..4", [4])]
)
def test_seeds_are_numbers_and_ranges(text: str, seeds: list[int]) -> None:
    assert [*_seeds(text)] == seeds


@pytest.mark.parametrize("text", ["8..1", "1..", "..3", "1-3", "1..3..5", ""])
def test_seeds_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(ArgumentTypeError, match=r"whole numbers|smaller number of a range first"):
        _seeds(text)


def test_without_seeds_and_repetitions_there_are_no_columns_for_them() -> None:
    (point,) = points_of({RATE: [1]}, seeds=[], repeat=1)
    assert point.values({RATE: "RATE"}) == {"RATE": 1}


def test_folders_of_points_are_readable_and_never_the_same() -> None:
    names = {RATE: "RATE"}
    one, other = Point({RATE: "a/b"}, 1), Point({RATE: "a b"}, 1)
    assert one.folder_name(names).startswith("RATE=a-b_seed=1-")
    assert one.folder_name(names) != other.folder_name(names)
    assert one.folder_name(names) == Point({RATE: "a/b"}, 1).folder_name(names)
    assert len(Point({RATE: "x" * 500}).folder_name(names)) < 100


@pytest.mark.parametrize(
    ("text", "values"),
    [
        (f"{RATE}=1,2,fast", ["1", "2", "fast"]),
        ("nodes.a.affinity=[0,1],[2]", [[0, 1], [2]]),
        ("connections.a.o.b.i.discard_limit=0,3", [0, 3]),
        ('nodes.a.script="x,y",z', ["x,y", "z"]),
    ],
)
def test_values_on_the_command_line(text: str, values: list[object]) -> None:
    assert parse_values(text) == (text.partition("=")[0], values)


@pytest.mark.parametrize(
    ("values", "reason"),
    [({RATE: []}, "give a value"), ({RATE: [1, 2, 1]}, "1 is given twice")],
)
def test_a_grid_with_holes_or_doubles_is_refused(values: dict[str, list[int]], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        points_of(values, [], 1)


def test_columns_have_the_shortest_names_that_tell_paths_apart() -> None:
    paths = ["nodes.a.environment.SEED", "nodes.b.environment.SEED", "budgets.wall_s"]
    assert [*short_names(paths).values()] == [
        "a.environment.SEED",
        "b.environment.SEED",
        "budgets.wall_s",
    ]
