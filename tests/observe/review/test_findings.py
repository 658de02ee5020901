"""The sentences at the top of a report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from run_folders import accounting, run_folder

from neuros.observe.review.run import open_for_review
from neuros.observe.review.words import Findings, findings_of

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
    assert "at most 1.2 times as fast, since slow" in found.gains[0]


def test_where_no_node_has_reported_that_is_said(tmp_path: Path) -> None:
    run = open_for_review(run_folder(tmp_path, {WIRE: 0}, {"fast": None, "slow": None}))
    assert "cannot be told" in findings_of(run).headline


def test_a_run_that_keeps_time_is_as_fast_as_it_should_be(tmp_path: Path) -> None:
    nodes = {"clock": accounting(executing={"tick": 0.1}, idle=9.9)}
    found = findings_of(open_for_review(run_folder(tmp_path, {}, nodes)))
    assert found.headline.startswith("The clock of clock limits the speed: 99% of its time")
    assert found.gains == (
        "No discard limit holds this run up: without them it would gain nothing.",
    )
