"""`neuros stop`, where there is nothing to stop."""

from __future__ import annotations

import pytest

from neuros.cli import sessions
from neuros.cli.main import main


def test_what_killed_runs_have_left_is_removed_and_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sessions, "sessions", list)
    monkeypatch.setattr(sessions, "remove_dead_runs", lambda: ("neuros_12", "neuros_34_image"))
    assert main(["stop"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "nothing is running",
        "removed neuros_12 from shared memory: its run was killed, and its guardian, too",
        "removed neuros_34_image from shared memory: its run was killed, and its guardian, too",
    ]
