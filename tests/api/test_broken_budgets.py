"""Whether a run has kept its project's budgets."""

from __future__ import annotations

from typing import Any

import pytest

from neuros.api.run_record import broken_budgets, losses
from neuros.project.model import Budgets

CONNECTION = "robot.imu -> snn.imu"


KILLED = "last report 5.8 s before the end"


def record(
    lost: int | None = 0,
    discarded: int | None = 0,
    factor: float | None = 1.0,
    worst_ms: float | None = None,
    *,
    sent: int | None = 10,
    received: int | None = 10,
    discard_limit: int | None = 0,
    robot: str | None = "final",
    snn: str | None = "final",
) -> dict[str, Any]:
    """The part of ``run.json`` that this is about; ``robot`` and ``snn`` are how nodes reported."""
    ticks = None if worst_ms is None else {"largest_error_ms": worst_ms}
    hooks = {"step": {"ticks": ticks}, "move": {}}
    connection = {"connection": CONNECTION, "discard_limit": discard_limit}
    counts = {"sent": sent, "received": received, "lost": lost, "discarded": discarded}
    return {
        "connections": [connection | counts],
        "real_time_factor": factor,
        "nodes": {
            "robot": {"hooks": hooks, "report": robot, "sim_time": factor},
            "snn": {"report": snn},
        },
    }


def test_without_budgets_nothing_is_broken() -> None:
    assert broken_budgets(record(100, 100, 0.001, 100.0), Budgets()) == []


def test_packets_that_were_lost_or_discarded_count_together() -> None:
    budgets = Budgets(lost_packets={CONNECTION: 5})
    assert broken_budgets(record(2, 3), budgets) == []
    assert broken_budgets(record(2, 4), budgets) == [
        f"{CONNECTION} lost 6 packets (2 on their way, 4 discarded); the limit is 5"
    ]


def test_the_real_time_factor_must_be_reached() -> None:
    budgets = Budgets(real_time_factor=0.5)
    assert broken_budgets(record(factor=0.5), budgets) == []
    assert broken_budgets(record(factor=0.421), budgets) == [
        "the real-time factor was 0.421, but must be at least 0.5"
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
        "a tick of 'step' of robot was off its period by 7.25 ms; the limit is 5 ms"
    ]


def test_a_figure_that_is_not_known_breaks_its_budget() -> None:
    budgets = Budgets({CONNECTION: 7}, real_time_factor=0.5, tick_error_ms=5)
    assert broken_budgets(record(None, None, worst_ms=1.0, robot=KILLED), budgets) == [
        f"it is not known how many packets {CONNECTION} lost; the limit is 7",
        "the real-time factor must be at least 0.5, but is not known: the last report of robot is"
        " missing",
        "it is not known how far ticks of robot were off their period; the limit is 5 ms",
    ]


def test_of_a_node_that_never_began_it_is_known_that_nothing_was_lost() -> None:
    never = record(None, None, sent=0, received=None, snn=None)
    assert broken_budgets(never, Budgets({CONNECTION: 0})) == []
    assert losses(never) == []


def test_nor_is_anything_lost_to_a_node_elsewhere_that_never_came() -> None:
    never = record(None, None, sent=0, received=None)
    del never["nodes"]["snn"]
    assert losses(never) == []


# ------------------------------------------------------------------ lossless connections


def test_where_all_that_was_sent_has_arrived_nothing_is_said() -> None:
    assert losses(record()) == []


@pytest.mark.parametrize("limit", [None, 3])
def test_nor_where_packets_may_be_lost(limit: int | None) -> None:
    assert losses(record(lost=2, received=8, discard_limit=limit)) == []


def test_a_packet_lost_on_a_lossless_connection_is_named() -> None:
    assert losses(record(lost=1, received=9)) == [
        f"{CONNECTION} lost 1 packet, though it is lossless (discard_limit 0)"
    ]


@pytest.mark.parametrize(
    ("sent", "received", "what"),
    [
        (None, 3, "the number of packets that were sent is not known"),
        (10, None, "it is not known how many of 10 packets arrived"),
        (
            *(10, 9),
            "the number of packets that it lost is not known: the last report of a node is missing",
        ),
    ],
)
def test_so_is_one_of_which_that_is_not_known(
    sent: int | None, received: int | None, what: str
) -> None:
    assert losses(record(None, sent=sent, received=received, snn=KILLED)) == [
        f"{CONNECTION} is lossless (discard_limit 0), but {what}"
    ]


# ------------------------------------------------------------------ all budgets


def test_every_budget_that_is_broken_is_listed() -> None:
    budgets = Budgets({CONNECTION: 0}, real_time_factor=2.0, tick_error_ms=1.0)
    assert len(broken_budgets(record(1, 0, 1.0, 2.0), budgets)) == 3
