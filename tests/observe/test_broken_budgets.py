"""Whether a run has kept its project's budgets."""

from __future__ import annotations

from typing import Any

from neuros.observe.budgets import broken_budgets
from neuros.project.model import Budgets

CONNECTION = "robot.imu -> snn.imu"


def record(
    lost: int | None = 0,
    discarded: int | None = 0,
    factor: float | None = 1.0,
    worst_ms: float | None = None,
) -> dict[str, Any]:
    """The part of ``run.json`` that budgets are about."""
    ticks = None if worst_ms is None else {"largest_error_ms": worst_ms}
    return {
        "connections": [{"connection": CONNECTION, "lost": lost, "discarded": discarded}],
        "real_time_factor": factor,
        "nodes": {"robot": {"hooks": {"step": {"ticks": ticks}, "move": {}}}, "dead": {}},
    }


def test_without_budgets_nothing_is_broken() -> None:
    assert broken_budgets(record(100, 100, 0.001, 100.0), Budgets()) == []


def test_packets_that_were_lost_or_discarded_count_together() -> None:
    budgets = Budgets(lost_packets={CONNECTION: 5})
    assert broken_budgets(record(2, 3), budgets) == []
    assert broken_budgets(record(2, 4), budgets) == [
        f"{CONNECTION} lost 6 packets (2 on their way, 4 discarded), allowed are 5"
    ]


def test_the_real_time_factor_must_be_reached() -> None:
    budgets = Budgets(real_time_factor=0.5)
    assert broken_budgets(record(factor=0.5), budgets) == []
    assert broken_budgets(record(factor=0.421), budgets) == [
        "the real-time factor was 0.421, and must be at least 0.5"
    ]


def test_no_real_time_factor_is_too_low_where_all_nodes_are_known() -> None:
    budgets = Budgets(real_time_factor=0.5)
    (text,) = broken_budgets(record(factor=None), budgets)
    assert "there was none" in text
    assert broken_budgets(record(factor=None), budgets, is_partial=True) == []


def test_the_worst_tick_of_any_hook_counts() -> None:
    budgets = Budgets(tick_error_ms=5)
    assert broken_budgets(record(worst_ms=5.0), budgets) == []
    assert broken_budgets(record(worst_ms=7.25), budgets) == [
        "a tick of 'step' of robot was off its period by 7.25 ms, allowed are 5 ms"
    ]


def test_what_nobody_reported_breaks_nothing() -> None:
    budgets = Budgets(lost_packets={CONNECTION: 0}, tick_error_ms=1)
    assert broken_budgets(record(lost=None, discarded=None), budgets) == []


def test_every_budget_that_is_broken_is_listed() -> None:
    budgets = Budgets({CONNECTION: 0}, real_time_factor=2.0, tick_error_ms=1.0)
    assert len(broken_budgets(record(1, 0, 1.0, 2.0), budgets)) == 3
