"""What is read of a run folder, whatever became of the run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from neuros_analysis.review import open_for_review
from run_folders import PACKETS, accounting, run_folder

from neuros.errors import EnvironmentFault, UsageError

WIRE = "a.out -> b.in"


def test_a_run_without_system_load_says_so(tmp_path: Path) -> None:
    run = open_for_review(run_folder(tmp_path, {WIRE: 0}, {"a": accounting(), "b": accounting()}))
    assert run.missing == ("processor and memory: the run was made without -m",)
    assert len(run.packets[WIRE].sent_ns) == PACKETS
    assert [*run.traces] == ["a", "b"]


def test_of_a_run_that_was_cut_off_packets_are_counted(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, {WIRE: 0}, {"a": accounting(), "b": accounting()})
    (folder / "run.json").unlink()
    ends = dict(zip(("source_node", "source_output", "destination_node", "destination_input"),
                    ("a", "out", "b", "in"), strict=True))  # fmt: skip
    nodes = [{"name": "a"}, {"name": "b"}]
    project = {"nodes": nodes, "connections": [ends | {"discard_limit": 0}]}
    (folder / "project.json").write_text(json.dumps(project))
    run = open_for_review(folder)
    assert run.connections[WIRE]["sent"] == run.connections[WIRE]["consumed"] == PACKETS
    assert run.connections[WIRE]["latency_ms"]["p50"] == 5.0
    assert run.missing[0].startswith("run.json: the run goes on, or its launcher was killed")
    assert run.time_budgets == {}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "not the folder of a run"),
        ('{"format": 2', "is broken"),
        ("[]", "is broken: it holds no object"),
        ('{"format": 3}', "has format 3, and this version of NeuROS reads format 2"),
        ('{"format": 2, "connections": 7}', "is broken"),
        ('{"format": 2, "connections": [{"connection": "a"}]}', "is broken"),
        ('{"format": 2, "nodes": {"a": 1}}', "is broken"),
        ('{"format": 2, "connections": [7]}', "is broken"),
    ],
)
def test_what_is_no_run_is_refused(tmp_path: Path, content: str | None, reason: str) -> None:
    if content is not None:
        (tmp_path / "run.json").write_text(content)
    with pytest.raises((UsageError, EnvironmentFault), match=reason):
        open_for_review(tmp_path)


def test_lists_that_a_killed_node_left_half_written_are_read_up_to_there(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, {WIRE: 0}, {"a": accounting(executing={"f": 1.0})})
    packets = folder / "a/packets"
    (packets / "executions").write_bytes((packets / "executions").read_bytes()[:-5])
    (packets / "hooks.json").write_text('[{"name"')
    trace = open_for_review(folder).traces["a"]
    assert len(trace.starts_ns) == PACKETS - 1
    assert trace.hooks == (("hook 1", "function"),)


def test_start_and_end_of_a_run_are_taken_off_what_a_node_waited_for(tmp_path: Path) -> None:
    """It waited 2 s for the others to begin, and 10 s are the run."""
    spent = accounting(executing={"f": 3.0}, blocked={WIRE: 9.0}, registering=5.0)
    run = open_for_review(run_folder(tmp_path, {WIRE: 0}, {"a": spent}))
    assert run.time_budgets["a"].blocked == {WIRE: 7.0}


def test_in_process_the_turns_of_others_are_no_execution(tmp_path: Path) -> None:
    """Nor do they count that came before all nodes ran, or after the end."""
    spent = accounting(executing={"f": 4.0}, waiting={"in": 1.0}, scheduling=8.0)
    run = open_for_review(run_folder(tmp_path, {}, {"a": spent}, backend="in-process"))
    shares = {"executing": 0.4, "waiting": 0.1, "blocked": 0.0, "idle": 0.0}
    assert run.time_budgets["a"].shares == pytest.approx(shares)


def test_initialise_hooks_do_not_count(tmp_path: Path) -> None:
    spent = accounting(executing={"init": 4.0}, waiting={"in": 10.0})
    run = open_for_review(run_folder(tmp_path, {}, {"b": spent}))
    assert run.time_budgets["b"].own_s == 0.0
    assert run.time_budgets["b"].waiting == {"in": 10.0}
