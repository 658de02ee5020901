"""From what nodes show of themselves to rates, shares and latencies."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace
from neuros_dashboard.live_metrics import LiveMetrics, Load

from neuros.control import LiveCounters, NodeStatus, Report
from neuros.recording.system_load import LAUNCHER, GroupLoad, MachineLoad

LINK = "a.o -> b.x"
STATES = ("waiting", "blocked", "executing", "idle", "registering", "scheduling", "paused")


def node_status(node: str, now_s: float, **shown: Any) -> NodeStatus:
    metrics: Any = {
        "state": {"state": "waiting", "cause": "x"},
        "executing": shown.get("hook"),
        "hooks": shown.get("hooks", {}),
        "accounting": {state: shown.get(state, 0.0) for state in STATES},
        "outgoing": shown.get("outgoing", {}),
        "incoming": shown.get("incoming", {}),
    }
    times = shown.get("sent_ns", {}), shown.get("taken_ns", {}), shown.get("paused_ns", ())
    return NodeStatus(node, 1, shown.get("sim_time"), LiveCounters(now_s, metrics, *times))


def outgoing(sent: int, outstanding: int = 0, *, is_reliable: bool = True) -> dict[str, Any]:
    blocked = {"is_blocked": outstanding > 0, "is_reliable": is_reliable}
    return {LINK: {"sent": sent, "outstanding": outstanding, **blocked}}


def incoming(received: int, discarded: int = 0) -> dict[str, Any]:
    return {LINK: {"received": received, "discarded": discarded, "unread": 0}}


def test_rates_are_those_of_the_last_second() -> None:
    figures = LiveMetrics()
    for tenth in range(40):
        sent = tenth if tenth < 20 else 20 + (tenth - 20) * 10
        figures.update(node_status("a", 100 + tenth / 10, outgoing=outgoing(sent)))
    assert figures.connections[LINK]["rate_hz"] == pytest.approx(100.0)


def test_the_rate_of_what_goes_back_begins_anew() -> None:
    figures = LiveMetrics()
    for tenth, sent in enumerate((50, 60, 70, 0, 10)):
        figures.update(node_status("a", 100 + tenth / 10, outgoing=outgoing(sent)))
    assert figures.connections[LINK]["rate_hz"] == pytest.approx(100.0)


def test_a_connection_has_the_counters_of_both_its_ends() -> None:
    figures = LiveMetrics()
    figures.update(node_status("b", 1.0, incoming=incoming(7, discarded=2)))
    figures.update(node_status("a", 1.0, outgoing=outgoing(8, outstanding=1)))
    shown = figures.connections[LINK]
    assert {key: shown[key] for key in ("sent", "received", "discarded", "outstanding")} == {
        "sent": 8,
        "received": 7,
        "discarded": 2,
        "outstanding": 1,
    }


def test_where_the_sender_is_not_seen_the_rate_is_that_of_arrivals() -> None:
    figures = LiveMetrics()
    for second in range(3):
        figures.update(node_status("b", second, incoming=incoming(5 * second)))
    assert figures.connections[LINK]["rate_hz"] == pytest.approx(5.0)


def test_latency_is_told_by_the_positions_of_packets_whoever_shows_itself_first() -> None:
    for is_sender_first in (True, False):
        figures = LiveMetrics()
        statuses = [
            node_status(
                "a", 1.0, outgoing=outgoing(12), sent_ns={LINK: (12, (7_000_000, 9_000_000))}
            ),
            node_status("b", 1.0, incoming=incoming(11), taken_ns={LINK: (11, 7_500_000)}),
        ]
        for each in statuses if is_sender_first else reversed(statuses):
            figures.update(each)
        figures.update(statuses[0])
        assert figures.connections[LINK]["latency_ms"] == pytest.approx(0.5)


def test_the_time_of_a_pause_is_no_latency() -> None:
    figures = LiveMetrics()
    figures.update(node_status("a", 1.0, outgoing=outgoing(1), sent_ns={LINK: (1, (1_000_000,))}))
    taken = {LINK: (1, 90_000_000)}
    paused = ((0, 500_000), (2_000_000, 89_500_000))
    figures.update(node_status("b", 1.0, incoming=incoming(1), taken_ns=taken, paused_ns=paused))
    assert figures.connections[LINK]["latency_ms"] == pytest.approx(1.5)


def test_shares_are_seconds_of_each_state_per_second() -> None:
    figures = LiveMetrics()
    figures.update(node_status("a", 1.0, executing={"f": 1.0}, waiting={"x": 2.0}))
    figures.update(node_status("a", 2.0, executing={"f": 1.25}, waiting={"x": 2.5, "y": 0.25}))
    shares = figures.nodes["a"]["shares"]
    assert (shares["executing"], shares["waiting"]) == (0.25, 0.75)


def test_hooks_have_their_count_and_mean_time() -> None:
    figures = LiveMetrics()
    hooks = {"f": {"executions": 10, "busy_s": 0.05}, "g": {"executions": 0, "busy_s": 0.0}}
    figures.update(node_status("a", 1.0, hooks=hooks))
    hooks = figures.nodes["a"]["hooks"]
    assert hooks["f"] == {"executions": 10, "rate_hz": 0.0, "mean_ms": pytest.approx(5.0)}
    assert hooks["g"]["mean_ms"] is None


def test_the_real_time_factor_is_that_of_now() -> None:
    figures = LiveMetrics()
    assert figures.real_time_factor is None
    figures.update(node_status("a", 10.0, sim_time=3.0))
    figures.update(node_status("a", 11.0, sim_time=5.0))
    assert (figures.sim_time, figures.real_time_factor) == (5.0, 2.0)


def test_a_node_that_loads_its_plugin_has_no_figures_yet() -> None:
    figures = LiveMetrics()
    figures.update(NodeStatus("a", 1))
    assert figures.nodes == {"a": {"state": "loading", "cause": ""}}


def lost(sent: list[int], received: list[int], hooks: list[float] | None = None) -> int:
    """What is shown as lost after a status of both ends every 200 ms.

    Args:
        hooks: for how long a hook of the receiver has been executing at each status, in seconds.
    """
    figures = LiveMetrics()
    for place, (out, arrived) in enumerate(zip(sent, received, strict=True)):
        now_s, for_s = 10 + 0.2 * place, hooks[place] if hooks else 0.0
        hook = {"name": "f", "for_s": for_s, "executions": 1} if for_s else None
        figures.update(node_status("a", now_s, outgoing=outgoing(out, is_reliable=False)))
        figures.update(node_status("b", now_s, incoming=incoming(arrived), hook=hook))
    return int(figures.connections[LINK]["lost"])


def test_what_was_sent_and_has_not_arrived_for_a_while_is_lost() -> None:
    assert lost([10 * n for n in range(30)], [max(0, 10 * n - 189) for n in range(30)]) in (
        188,
        189,
    )


def test_what_is_under_way_is_not_lost() -> None:
    sent = [10 * n for n in range(60)]
    assert lost(sent, [max(0, count - n % 10) for n, count in enumerate(sent)]) == 0


def test_what_waits_for_a_hook_to_end_is_not_lost() -> None:
    """The hook starts again every 5 s, with all that has arrived by then."""
    since = [0.2 * (n % 25) + 0.001 for n in range(100)]
    assert lost(list(range(100)), [n - n % 25 for n in range(100)], since) == 0


def test_nothing_is_lost_on_a_reliable_connection() -> None:
    figures = LiveMetrics()
    figures.update(node_status("a", 1.0, outgoing=outgoing(5)))
    assert figures.connections[LINK]["lost"] == 0


def test_after_the_end_counts_are_final_and_shares_those_of_the_run() -> None:
    figures = LiveMetrics()
    figures.update(
        node_status("a", 1.0, outgoing=outgoing(5, 1), sim_time=1.0, hook={"name": "f", "for_s": 1})
    )
    figures.update(node_status("b", 1.0, incoming=incoming(1)))
    nothing = dict.fromkeys(STATES, 0.0) | {"executing": {}, "waiting": {}, "blocked": {}}
    ends = {
        "a": (
            {LINK: {"sent": 8, "outstanding": 2}},
            {},
            {"executing": {"f": 1.0}, "idle": 3.0},
        ),
        "b": ({}, {LINK: {"received": 6, "discarded": 2, "unread": 0}}, {"waiting": {"x": 4.0}}),
    }
    metrics: dict[str, Any] = {
        name: {
            "outgoing": out,
            "incoming": into,
            "accounting": nothing | spent,
            "hooks": {"f": {"executions": 4, "busy_s": 1.0}},
        }
        for name, (out, into, spent) in ends.items()
    }
    reports = {
        name: Report(node=name, metrics=each, is_final=True) for name, each in metrics.items()
    }
    figures.end(reports, 4.0, 0.25, has_drained=True)
    assert {node["state"] for node in figures.nodes.values()} == {"ended"}
    assert figures.nodes["a"]["shares"] == pytest.approx(
        {"executing": 0.25, "waiting": 0, "blocked": 0, "idle": 0.75}
    )
    shown = figures.connections[LINK]
    assert (shown["sent"], shown["discarded"], shown["lost"], shown["is_blocked"]) == (
        8,
        2,
        2,
        False,
    )
    assert (shown["rate_hz"], figures.real_time_factor) == (2.0, 0.25)

    figures.end(reports, 4.0, 0.25, has_drained=False)
    assert figures.connections[LINK]["lost"] == 0, "they are in flight"

    reports["b"] = replace(reports["b"], is_final=False)
    figures.end(reports, 4.0, 0.25, has_drained=True)
    assert figures.connections[LINK]["lost"] is None


class SteadyMeter:
    cpu_s = 10.0

    def machine(self) -> MachineLoad:
        return MachineLoad((50.0, 20.0), 3_000, 40.0, 1, 2)

    def groups(self) -> dict[str, GroupLoad]:
        return {"robot": GroupLoad(self.cpu_s, 500, 7), LAUNCHER: GroupLoad(1.0, 900, 2)}


def test_processor_time_is_that_since_the_last_call(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, meter = [1.0], SteadyMeter()
    monkeypatch.setattr("time.monotonic", lambda: now_s[0])
    load = Load(meter)
    assert load()["groups"]["robot"]["cpu_percent"] == 0.0
    now_s[0], meter.cpu_s = 3.0, 11.0
    shown = load()
    assert shown["groups"]["robot"] == {"cpu_percent": 50.0, "memory_bytes": 500, "threads": 7}
    assert shown["groups"]["dashboard"] == {"cpu_percent": 0.0, "memory_bytes": 900, "threads": 2}
    assert shown["cores"] == [50.0, 20.0]
