"""What is said of packets, depending on who has reported what."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from neuros.api.run_record import run_record
from neuros.control import Report
from neuros.launcher.outcome import Outcome
from neuros.project.load import load_project
from neuros.project.model import Folders
from neuros.project.split import split

PROJECT = Path(__file__).parents[2] / "examples/1_tick/clock/project.json"
CONNECTION = "clock.time -> display.time"
ROWS = {
    "clock": {"outgoing": {CONNECTION: {"sent": 7, "outstanding": 2}}, "incoming": {}},
    "display": {"outgoing": {}, "incoming": {CONNECTION: {"received": 5}}},
}


def report(name: str, *, is_final: bool) -> Report:
    metrics: Any = {"accounting": {}, "hooks": {}, **ROWS[name]}
    return Report(node=name, metrics=metrics, is_final=is_final)


@pytest.mark.parametrize(
    ("final", "has_drained", "lost", "in_flight"),
    [
        ({"clock", "display"}, True, 2, 0),
        ({"clock", "display"}, False, 0, 2),
        ({"display"}, True, None, None),
        ({"clock"}, False, None, None),
    ],
)
def test_nobody_knows_what_was_lost_once_a_node_was_killed(
    final: set[str], has_drained: bool, lost: int | None, in_flight: int | None, tmp_path: Path
) -> None:
    project = load_project(PROJECT, workspace=tmp_path).project
    ended = Outcome(exit_code=1, reason="killed", ended_s=2.0, has_drained=has_drained)
    ended.reports = {name: report(name, is_final=name in final) for name in ROWS}
    ended.report_times_s = dict.fromkeys(ROWS, 1.5)
    files = split(project, lambda _: Folders(tmp_path, tmp_path, tmp_path))
    (connection,) = run_record(project, files, ended, 1.0, tmp_path)["connections"]
    assert (connection["sent"], connection["received"]) == (7, 5)
    assert (connection["lost"], connection["in_flight"]) == (lost, in_flight)
