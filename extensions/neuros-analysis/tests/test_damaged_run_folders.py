"""A run folder that something has happened to: what is wrong is said, and takes no memory."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from neuros_analysis.review import open_for_review
from run_folders import PACKETS, accounting, run_folder

from neuros.api.run_record import open_run
from neuros.cli.main import main
from neuros.errors import EnvironmentFault
from neuros.recording.recording_plan import load_plan

WIRE = "a.out -> b.in"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return run_folder(tmp_path, {WIRE: 0}, {"a": accounting(executing={"f": 1.0}), "b": None})


def change(folder: Path, *keys: str | int, to: Any) -> None:
    """Replace a value in ``run.json``."""
    record = json.loads((folder / "run.json").read_text())
    inside = record
    for key in keys[:-1]:
        inside = inside[key]
    inside[keys[-1]] = to
    (folder / "run.json").write_text(json.dumps(record))


@pytest.mark.parametrize(
    ("keys", "value", "said"),
    [
        (("running_s",), "long", "$.running_s: must be a number or null, but is a text"),
        (("running_s",), float("nan"), "$.running_s: must be a number or null, but is nan"),
        (("wall_s",), 10**400, "$.wall_s: must be at most 9223372036854775807, but is 1000"),
        (
            ("connections", 0, "connection"),
            "../../x",
            "$.connections[0].connection: '../../x' is not allowed as ends of a connection",
        ),
        (("connections", 0, "index"), -1, "$.connections[0].index: must be at least 0, but is -1"),
        (("connections", 0, "index"), 1.0, "$.connections[0].index: must be a whole number"),
        (("connections", 0, "latency_ms"), [], "$.connections[0].latency_ms: must be an object"),
        (("nodes", "../b"), {}, "$.nodes: '../b' is not allowed as name of a node"),
        (("nodes", "a", "accounting"), 5, "$.nodes.a.accounting: must be an object or null"),
        (("nodes", "a"), None, "$.nodes.a: must be an object, but is null"),
        (("nodes", "a", "hooks", "f"), {}, "$.nodes.a.hooks.f: the key 'executions' is missing"),
        (
            ("nodes", "a", "hooks", "f"),
            {"executions": 1, "ticks": {"period_ms": 1, "within": {}}},
            "$.nodes.a.hooks.f.ticks: the key 'std_ms' is missing",
        ),
        (("timeline",), {"a": [[1, 2, 3]]}, "$.timeline.a[0]: has more than 2 items"),
        (
            ("system_load",),
            {"machine": {"cpu_percent_mean": 1, "cpu_percent_max": 1, "cores": 0}},
            "$.system_load.machine.cores: must be at least 1, but is 0",
        ),
        (("machine",), {"cores": "many"}, "$.machine.cores: must be a whole number or null"),
    ],
)
def test_a_damaged_record_is_named_with_the_place(
    folder: Path, capsys: pytest.CaptureFixture[str], keys: Any, value: Any, said: str
) -> None:
    change(folder, *keys, to=value)
    for command in (["report"], ["verify", str(folder)], ["compare"]):
        code = main([*command, str(folder)])
        assert code == (2 if command == ["compare"] else 4)  # all runs are left out
        assert f"run.json is broken: {said}" in capsys.readouterr().err


def test_a_record_is_a_file_and_no_pipe(folder: Path) -> None:
    (folder / "run.json").unlink()
    os.mkfifo(folder / "run.json")
    with pytest.raises(EnvironmentFault, match="it is not an ordinary file"):
        open_run(folder)


def test_a_hook_of_an_impossible_number_takes_no_memory(folder: Path) -> None:
    list_ = folder / "a/packets/executions"
    rows = np.frombuffer(list_.read_bytes(), np.int64).reshape(-1, 3).copy()
    rows[20, 0] = 1 << 40
    list_.write_bytes(rows.tobytes())
    run = open_for_review(folder)
    assert len(run.traces["a"].starts_ns) == 20
    assert f"the rest of {list_}: the file is damaged" in run.missing


@pytest.mark.parametrize("value", [0, -1, -(1 << 62)])
def test_packets_that_no_hook_can_have_taken_are_left_out(folder: Path, value: int) -> None:
    list_ = folder / "b/packets/0.taken"
    taken = np.frombuffer(list_.read_bytes(), np.int64).copy()
    taken[10] = value
    list_.write_bytes(taken.tobytes())
    run = open_for_review(folder)
    assert len(run.packets[WIRE].taken) == 10 < PACKETS
    assert run.latencies_ns(WIRE) is not None
    assert f"the rest of {list_}: the file is damaged" in run.missing


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[" * 5000,
        '{"version": 1, "topics": [{"name": 5, "type": "x"}], "streams": {}, "storage": "mcap"}',
        '{"version": 1, "topics": [], "streams": {"a": [{"way": "sent", "name": "x", "topics":'
        ' [3]}]}, "storage": "mcap"}',
        '{"version": 1, "topics": [], "streams": {"../a": []}, "storage": "mcap"}',
    ],
)
def test_a_damaged_plan_of_a_recording_is_damage_and_no_wrong_usage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    (tmp_path / "recording.json").write_text(text)
    with pytest.raises(EnvironmentFault, match=r"recording\.json is damaged: "):
        load_plan(tmp_path)
    assert main(["bag", "repair", str(tmp_path)]) == 4
    assert "is damaged" in capsys.readouterr().err


def test_a_project_of_a_run_that_was_cut_off_may_be_damaged(folder: Path) -> None:
    (folder / "run.json").unlink()
    shutil.copy(__file__, folder / "project.json")
    with pytest.raises(EnvironmentFault, match=r"project\.json is broken"):
        open_for_review(folder)
    (folder / "project.json").write_text('{"nodes": [{"name": "../x"}], "connections": [[]]}')
    with pytest.raises(EnvironmentFault, match=r"project\.json is broken"):
        open_for_review(folder)
