"""A run that breaks a budget of its project ends with exit code 5 and says which."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from launching import BACKENDS, EXAMPLES, Finished, launch

CLOCK = "clock.time -> display.time"


def run(folder: Path, budgets: dict[str, Any], back_end: str = "process") -> Finished:
    """The clock, for two and a half seconds, with these budgets."""
    for file in (EXAMPLES / "1_tick/clock").glob("*.*"):
        (folder / file.name).write_bytes(file.read_bytes())
    project = json.loads((folder / "project.json").read_text())
    project.pop("$schema", None)
    (folder / "project.json").write_text(json.dumps({**project, "budgets": budgets}))
    return launch(folder, "--backend", back_end, "--duration", "2.5", cwd=folder)


def test_a_run_within_its_budgets_ends_as_ever(tmp_path: Path) -> None:
    finished = run(tmp_path, {"lost_packets": {CLOCK: 0}, "tick_error_ms": 2000})
    assert finished.exit_code == 0, finished.output
    assert finished.record["broken_budgets"] == []
    assert finished.record["expanded_project"]["budgets"]["lost_packets"] == {CLOCK: 0}


@pytest.mark.parametrize("back_end", BACKENDS)
def test_every_broken_budget_is_named(tmp_path: Path, back_end: str) -> None:
    budgets = {"lost_packets": {CLOCK: 0}, "tick_error_ms": 1e-6, "real_time_factor": 1}
    finished = run(tmp_path, budgets, back_end)
    assert finished.exit_code == 5, finished.output
    said = [text for text in finished.said("neuros") if text.startswith("budget broken: ")]
    assert any("the real-time factor must be at least 1, but there was none" in t for t in said)
    assert any("of clock was off its period by" in text for text in said)
    assert not any(CLOCK in text for text in said)
    assert finished.record["exit_code"] == 5
    assert len(finished.record["broken_budgets"]) == len(said) == 2
