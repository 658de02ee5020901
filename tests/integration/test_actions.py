"""Actions of ROS, served and called by plugins, between hooks."""

from __future__ import annotations

from pathlib import Path

import pytest
from launching import BACKENDS, launch

from containers import require_containers

PROJECT = Path(__file__).parent / "actions"


@pytest.mark.acceptance
@pytest.mark.parametrize("back_end", [*BACKENDS, "docker"])
def test_an_action_is_served_and_called(back_end: str, tmp_path: Path) -> None:
    if back_end == "docker":
        require_containers()
    run = launch(PROJECT, "--backend", back_end, cwd=tmp_path, timeout_s=90.0)
    assert run.exit_code == 0, run.output
    reason = "guide ended the project: refused: True, feedback [1, 2, 3], done 3"
    assert run.record["reason"] == reason
    assert run.record["nodes"]["walker"]["hooks"]["run_freely"]["executions"] > 20
