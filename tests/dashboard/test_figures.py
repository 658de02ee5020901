"""From what nodes show of themselves to rates, shares and latencies."""

from __future__ import annotations

from typing import Any

import pytest

from neuros.dashboard.figures import Figures

LINK = "a.o -> b.x"
STATES = ("waiting", "blocked", "executing", "idle", "registering", "scheduling", "paused")


def glimpse(node: str, now_s: float, **books: Any) -> dict[str, Any]:
    spent = {state: books.get(state, 0.0) for state in STATES}
    return {
        "node": node,
        "sim_time": books.get("sim_time"),
        "books": {
            "now_s": now_s,
            "state": {"state": "waiting", "cause": "x"},
            "executing": None,
            "hooks": books.get("hooks", {}),
            "accounting": spent,
            "outgoing": books.get("outgoing", {}),
            "incoming": books.get("incoming", {}),
            "sent_ns": books.get("sent_ns", {}),
            "taken_ns": books.get("taken_ns", {}),
            "is_paused": False,
        },
    }


def outgoing(sent: int, outstanding: int = 0) -> dict[str, Any]:
    return {LINK: {"sent": sent, "outstanding": outstanding, "is_blocked": outstanding > 0}}


def incoming(received: int, discarded: int = 0) -> dict[str, Any]:
    return {LINK: {"received": received, "discarded": discarded, "unread": 0}}


def test_rates_are_those_of_the_last_second() -> None:
    figures = Figures()
    for tenth in range(40):
        sent = tenth if tenth < 20 else 20 + (tenth - 20) * 10
        figures.take(glimpse("a", 100 + tenth / 10, outgoing=outgoing(sent)))
    assert figures.connections[LINK]["rate_hz"] == pytest.approx(100.0)


def test_a_connection_has_the_counters_of_both_its_ends() -> None:
    figures = Figures()
    figures.take(glimpse("b", 1.0, incoming=incoming(7, discarded=2)))
    figures.take(glimpse("a", 1.0, outgoing=outgoing(8, outstanding=1)))
    shown = figures.connections[LINK]
    assert {key: shown[key] for key in ("sent", "received", "discarded", "outstanding")} == {
        "sent": 8,
        "received": 7,
        "discarded": 2,
        "outstanding": 1,
    }


def test_where_the_sender_is_not_seen_the_rate_is_that_of_arrivals() -> None:
    figures = Figures()
    for second in range(3):
        figures.take(glimpse("b", second, incoming=incoming(5 * second)))
    assert figures.connections[LINK]["rate_hz"] == pytest.approx(5.0)


def test_latency_is_told_by_the_positions_of_packets_whoever_shows_itself_first() -> None:
    for is_sender_first in (True, False):
        figures = Figures()
        glimpses = [
            glimpse("a", 1.0, outgoing=outgoing(12), sent_ns={LINK: [12, [7_000_000, 9_000_000]]}),
            glimpse("b", 1.0, incoming=incoming(11), taken_ns={LINK: [11, 7_500_000]}),
        ]
        for each in glimpses if is_sender_first else reversed(glimpses):
            figures.take(each)
        figures.take(glimpses[0])
        assert figures.connections[LINK]["latency_ms"] == pytest.approx(0.5)


def test_shares_are_seconds_of_each_state_per_second() -> None:
    figures = Figures()
    figures.take(glimpse("a", 1.0, executing={"f": 1.0}, waiting={"x": 2.0}))
    figures.take(glimpse("a", 2.0, executing={"f": 1.25}, waiting={"x": 2.5, "y": 0.25}))
    shares = figures.nodes["a"]["shares"]
    assert (shares["executing"], shares["waiting"]) == (0.25, 0.75)


def test_hooks_have_their_count_and_mean_time() -> None:
    figures = Figures()
    figures.take(glimpse("a", 1.0, hooks={"f": [10, 0.05], "g": [0, 0.0]}))
    hooks = figures.nodes["a"]["hooks"]
    assert hooks["f"] == {"executions": 10, "rate_hz": 0.0, "mean_ms": pytest.approx(5.0)}
    assert hooks["g"]["mean_ms"] is None


def test_the_real_time_factor_is_that_of_now() -> None:
    figures = Figures()
    assert figures.real_time_factor is None
    figures.take(glimpse("a", 10.0, sim_time=3.0))
    figures.take(glimpse("a", 11.0, sim_time=5.0))
    assert (figures.sim_time, figures.real_time_factor) == (5.0, 2.0)


def test_a_node_that_loads_its_plugin_has_no_figures_yet() -> None:
    figures = Figures()
    figures.take({"node": "a", "sim_time": None, "books": None})
    assert figures.nodes == {"a": {"state": "loading", "cause": ""}}
