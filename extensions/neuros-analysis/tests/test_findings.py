"""The bottleneck of runs whose time budgets are given, and the sentences about it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from neuros_analysis.findings import Bottleneck, Findings, find_bottleneck, findings_of
from neuros_analysis.review import open_for_review
from run_folders import accounting, run_folder, wires

from neuros.engine.metrics import TimeBudget

TEN_S = 10.0


def spent(
    *,
    executing: float = 0.0,
    waiting: Mapping[str, float] | None = None,
    blocked: Mapping[str, float] | None = None,
    idle: float = 0.0,
) -> TimeBudget:
    return TimeBudget({"hook": executing}, waiting or {}, blocked or {}, idle, 0.0)


def find(
    budgets: Mapping[str, TimeBudget], owner: str | None = None, **limits: int | None
) -> Bottleneck:
    found = find_bottleneck(budgets, wires(**limits), TEN_S, owner)
    assert found is not None
    return found


def gains(found: Bottleneck) -> dict[tuple[str, ...], float]:
    return {gain.connections: pytest.approx(gain.up_to) for gain in found.gains}


def test_one_slow_consumer() -> None:
    """The source needs 2 of 10 s, and waits for the consumer in the others."""
    to_sink = "source.out -> sink.in_source"
    found = find(
        {"source": spent(executing=2, blocked={to_sink: 8}), "sink": spent(executing=10)},
        source_sink=0,
    )
    assert (found.pacing, found.root, found.loop) == ("source", "sink", ())
    assert [step.state for step in found.steps] == ["blocked", "executing"]
    assert gains(found) == {(to_sink,): 5.0}


def test_of_two_stages_the_last_holds_up_both() -> None:
    """Free of the last stage, the run is as fast as the first: 6 of 10 s."""
    to_first, to_last = "source.out -> first.in_source", "first.out -> last.in_first"
    found = find(
        {
            "source": spent(executing=1, blocked={to_first: 9}),
            "first": spent(executing=6, blocked={to_last: 4}),
            "last": spent(executing=10),
        },
        source_first=0,
        first_last=0,
    )
    assert [step.node for step in found.steps] == ["source", "first", "last"]
    assert found.root == "last"
    assert gains(found) == {(to_first,): 10.0, (to_last,): 10 / 6}


def test_where_all_are_equally_fast_nothing_can_be_gained() -> None:
    to_sink = "source.out -> sink.in_source"
    found = find(
        {
            "source": spent(executing=9.5, blocked={to_sink: 0.5}),
            "sink": spent(executing=9.6, waiting={"in_source": 0.4}),
        },
        source_sink=0,
    )
    assert found.root == "source"
    assert gains(found) == {(to_sink,): 10 / 9.5}


def test_one_of_two_slow_consumers_alone_is_no_gain() -> None:
    one, two = "source.out -> one.in_source", "source.out -> two.in_source"
    found = find(
        {
            "source": spent(executing=1, blocked={one: 6, two: 3}),
            "one": spent(executing=9.5),
            "two": spent(executing=9.0),
        },
        source_one=0,
        source_two=0,
    )
    assert found.root == "one"
    assert gains(found) == {(one,): 10 / 9, (two,): 10 / 9.5}


def test_what_reaches_the_root_on_two_ways_is_freed_together() -> None:
    """As strict against hybrid whiskeye: the plots hold up robot and network."""
    pose, imu, estimate = (
        "robot.out -> plot.in_robot", "robot.out -> snn.in_robot", "snn.out -> plot.in_snn",
    )  # fmt: skip
    found = find(
        {
            "robot": spent(executing=1, blocked={pose: 5, imu: 4}),
            "snn": spent(executing=4, blocked={estimate: 4}, waiting={"in_robot": 2}),
            "plot": spent(executing=10),
        },
        "robot",
        robot_plot=0,
        robot_snn=0,
        snn_plot=0,
    )
    assert found.root == "plot"
    assert found.gains[0].connections == (pose, estimate)
    assert found.gains[0].up_to == pytest.approx(2.5)
    assert {gain.up_to for gain in found.gains[1:]} == {1.0}


def test_two_that_wait_for_each_other_have_no_bottleneck() -> None:
    """Most of the time their packets are under way."""
    found = find(
        {
            "a": spent(executing=1, waiting={"in_b": 9}),
            "b": spent(executing=2, waiting={"in_a": 8}),
        },
        a_b=0,
        b_a=0,
    )
    assert found.root is None
    assert {*found.loop} == {"a", "b"}
    assert found.gains == ()


def test_in_a_loop_the_one_that_executes_most_is_the_root() -> None:
    found = find(
        {
            "robot": spent(executing=2, waiting={"in_brain": 8}),
            "brain": spent(executing=7, waiting={"in_robot": 3}),
        },
        "robot",
        robot_brain=0,
        brain_robot=0,
    )
    assert found.root == "brain"


def test_a_node_that_waits_for_its_clock_is_the_root() -> None:
    found = find({"ticker": spent(executing=1, idle=9), "sink": spent(waiting={"in_ticker": 10})},
                 ticker_sink=0)  # fmt: skip
    assert found.root == "ticker"
    assert found.steps[-1].state == "idle"


def test_an_external_topic_ends_the_search_without_a_root() -> None:
    found = find({"node": spent(executing=1, waiting={"camera": 9})})
    assert found.root is None
    assert found.steps[-1].cause == "camera"


def test_where_nobody_has_reported_nothing_is_found() -> None:
    assert find_bottleneck({}, wires(a_b=0), TEN_S) is None


WIRE = "fast.out -> slow.in"


def findings(folder: Path, limit: int | None = 0, **more: Any) -> Findings:
    """Of a run whose sender needs a fifth of the time, and whose receiver needs all of it."""
    fast = accounting(executing={"make": 2.0}, blocked={WIRE: 8.0})
    slow = accounting(executing={"use": 9.5}, waiting={"in": 0.5})
    nodes = {"fast": fast, "slow": slow}
    return findings_of(open_for_review(run_folder(folder, {WIRE: limit}, nodes, **more)))


def test_the_hook_the_share_and_the_gain_are_named(tmp_path: Path) -> None:
    found = findings(tmp_path, real_time_factor=2.0)
    assert found.headline == (
        "slow.use limits the speed: it executes 95% of the time, while fast, which sets the pace,"
        " needs 20% for itself."
    )
    assert found.reasons[0] == (f"fast is blocked 80% of the time ({WIRE} 80%), and executes 20%.")
    assert found.gains == (
        f"Without the discard limit of {WIRE}: up to 5.0 times as fast (real-time factor 2.00,"
        " then up to 10.00). Packets may then be lost there.",
    )


def test_the_prediction_can_be_tested_by_a_command(tmp_path: Path) -> None:
    assert findings(tmp_path).trial == (
        "neuros launch made/project.json --set connections.fast.out.slow.in.discard_limit="
    )


def test_the_command_can_be_pasted_wherever_the_project_is(tmp_path: Path) -> None:
    trial = findings(tmp_path, file="/my lab/project.json").trial
    assert trial is not None
    assert trial.startswith("neuros launch '/my lab/project.json' --set connections.fast.")


def test_where_no_hook_has_executed_none_is_named(tmp_path: Path) -> None:
    run = open_for_review(run_folder(tmp_path, {}, {"a": accounting()}))
    assert findings_of(run).headline == "Nothing limits the speed: no hook has executed."


def test_a_node_that_waits_for_itself_is_told_as_such(tmp_path: Path) -> None:
    nodes = {"a": accounting(waiting={"in": 9.0})}
    run = open_for_review(run_folder(tmp_path, {"a.out -> a.in": 0}, nodes))
    assert (
        "No single hook limits the speed: a waits for its own packets" in findings_of(run).headline
    )


def test_a_busy_machine_is_mentioned(tmp_path: Path) -> None:
    reasons = findings(tmp_path, machine={"cores": 1}).reasons
    assert reasons[-1].startswith("The processor was 100% busy")
    assert not any("busy" in reason for reason in findings(tmp_path).reasons)


def test_in_process_no_gain_is_promised_for_a_discard_limit(tmp_path: Path) -> None:
    found = findings(tmp_path, backend="in-process")
    assert found.headline.startswith("One thread runs all hooks in turn (in-process); slow.use")
    assert found.trial is None
    assert "up to 1.2 times as fast; then slow is the limit" in found.gains[0]


def test_where_no_node_has_reported_that_is_said(tmp_path: Path) -> None:
    run = open_for_review(run_folder(tmp_path, {WIRE: 0}, {"fast": None, "slow": None}))
    assert "not known" in findings_of(run).headline


def test_a_run_that_keeps_time_is_as_fast_as_it_should_be(tmp_path: Path) -> None:
    nodes = {"clock": accounting(executing={"tick": 0.1}, idle=9.9)}
    found = findings_of(open_for_review(run_folder(tmp_path, {}, nodes)))
    assert found.headline.startswith("The clock of clock limits the speed: 99% of its time")
    assert found.gains == ("Discard limits do not slow this run down.",)
