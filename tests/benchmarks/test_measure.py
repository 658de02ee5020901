"""How candidates are measured: side by side, in rounds, whatever goes wrong with one of them."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from benchmarks.measure import (
    Case,
    Difference,
    Figure,
    Group,
    Measurement,
    Quotient,
    Run,
    Subject,
    Unavailable,
)
from benchmarks.results import Results
from benchmarks.rows import Row, row_of
from benchmarks.running import measure


def silent(line: str) -> None:
    """Show no progress."""


def constant(value: float) -> Measurement:
    return lambda: value


def failing(error: Exception, *then: float) -> Measurement:
    """Fails once, or always if nothing follows."""
    following = iter(then)
    is_first = True

    def measurement() -> float:
        nonlocal is_first
        if is_first or not then:
            is_first = False
            raise error
        return next(following)

    return measurement


def results_of(
    group: Group, rounds: int | None = None, say: Callable[[str], None] = silent
) -> Results:
    results = Results()
    measure({"subject": Subject("", (group,))}, results, None, say, rounds)
    return results


def row_named(results: Results, name: str) -> Row:
    (row,) = (row for row in results.rows if row.name == name)
    return row


def versus(name: str, candidate: str, reference: str) -> Case:
    return Case(name, "us", Figure(candidate), Figure(reference), reference)


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.running.load_before", lambda _: 0.0)


def test_every_other_round_runs_the_other_way_round() -> None:
    order: list[str] = []

    def note(name: str) -> Measurement:
        return lambda: order.append(name) or 1.0

    group = Group({name: note(name) for name in "abc"}, (versus("r", "a", "b"),), rounds=3)
    group = Group(group.candidates, (*group.cases, versus("s", "a", "c")), rounds=3)
    results_of(group)
    assert "".join(order) == "abccbaabc"


def test_a_round_in_slices_goes_there_and_back_and_has_the_means() -> None:
    order: list[str] = []

    def noted(name: str, *values: float) -> Measurement:
        following = iter(values)
        return lambda: order.append(name) or next(following)  # type: ignore[func-returns-value]

    candidates = {"a": noted("a", 1, 3, 10, 20), "b": noted("b", 2, 2, 5, 5)}
    group = Group(candidates, (versus("r", "a", "b"),), rounds=2, slices=2)
    row = row_named(results_of(group), "r")
    assert "".join(order) == "abba" + "baab"
    assert (row.values, row.references) == ((2.0, 15.0), (2.0, 5.0))


def test_a_failure_in_one_slice_costs_the_round() -> None:
    a = failing(RuntimeError("once"), 1.0, 1.0, 1.0)
    group = Group({"a": a, "b": constant(2)}, (versus("r", "a", "b"),), rounds=2, slices=2)
    row = row_named(results_of(group), "r")
    assert row.values == (1.0,)


def test_the_rounds_of_a_group_can_be_overridden() -> None:
    group = Group({"a": constant(1)}, (Case("r", "us", Figure("a")),), rounds=7)
    assert len(row_named(results_of(group), "r").values) == 7
    assert len(row_named(results_of(group, rounds=3), "r").values) == 3


def test_ratios_are_those_within_the_rounds() -> None:
    a, b = iter([2.0, 30.0]), iter([10.0, 1.0])
    group = Group({"a": lambda: next(a), "b": lambda: next(b)}, (versus("r", "a", "b"),), 2)
    assert row_named(results_of(group), "r").ratios == (0.2, 30.0)


def test_a_value_may_be_made_of_several_figures_of_a_round() -> None:
    group = Group(
        {"a": lambda: {"median": 6.0, "p99": 9.0}, "b": constant(2)},
        (
            Case("p99", "us", Figure("a", "p99")),
            Case("quotient", "", Quotient(Figure("a", "median"), Figure("b"))),
            Case("difference", "us", Difference(Figure("a", "median"), Figure("b"))),
        ),
        rounds=1,
    )
    results = results_of(group)
    assert [row.values for row in results.rows] == [(9.0,), (3.0,), (4.0,)]


def test_what_is_unavailable_is_left_out_with_a_notice_and_tried_once() -> None:
    tries: list[int] = []

    def dora() -> float:
        tries.append(1)
        raise Unavailable("dora-rs is not installed")

    group = Group(
        {"neuros": constant(1), "rclpy": constant(2), "dora": dora},
        (versus("against rclpy", "neuros", "rclpy"), versus("against dora", "neuros", "dora")),
        rounds=4,
    )
    results = results_of(group)
    assert [row.name for row in results.rows] == ["against rclpy"]
    (notice,) = results.notices
    assert (notice.row, notice.reason) == ("against dora", "dora-rs is not installed")
    assert not notice.is_failure
    assert len(tries) == 1


def test_a_failure_costs_the_row_one_round_and_is_told() -> None:
    group = Group(
        {"a": constant(1), "b": failing(RuntimeError("node died"), 2, 2)},
        (versus("r", "a", "b"),),
        rounds=3,
    )
    results = results_of(group)
    assert row_named(results, "r").ratios == (0.5, 0.5)
    (notice,) = results.notices
    assert notice.is_failure
    assert notice.reason == "b failed 1 x: RuntimeError: node died"


def test_what_fails_twice_is_not_tried_again_and_costs_the_others_nothing() -> None:
    group = Group(
        {"a": constant(1), "b": failing(RuntimeError("node died"))},
        (Case("a alone", "us", Figure("a")), versus("r", "a", "b")),
        rounds=5,
    )
    results = results_of(group)
    assert [row.name for row in results.rows] == ["a alone"]
    assert len(results.rows[0].values) == 5
    assert [notice.reason for notice in results.notices] == [
        "b failed 2 x: RuntimeError: node died"
    ]


def test_ctrl_c_keeps_the_rounds_before_it() -> None:
    values = iter([1.0, 2.0])

    def interrupted() -> float:
        try:
            return next(values)
        except StopIteration:
            raise KeyboardInterrupt from None

    group = Group({"a": interrupted, "b": constant(1)}, (versus("r", "a", "b"),))
    results = Results()
    with pytest.raises(KeyboardInterrupt):
        measure({"subject": Subject("", (group,))}, results, None, silent)
    assert row_named(results, "r").values == (1.0, 2.0)


def test_only_what_the_chosen_rows_need_is_measured() -> None:
    group = Group(
        {"a": constant(1), "b": constant(2), "c": constant(3)},
        (versus("one core", "a", "b"), versus("a core each", "a", "c")),
    ).only("ONE core")
    assert list(group.candidates) == ["a", "b"]
    assert [case.name for case in group.cases] == ["one core"]


def test_a_figure_that_no_measurement_has_is_an_error() -> None:
    run = Run(Group({"a": constant(1)}, (Case("r", "us", Figure("a", "p99")),)))
    for _ in run.measure(1, silent):
        pass
    with pytest.raises(KeyError, match="p99"):
        row_of("subject", run.group.cases[0], run.rounds)
