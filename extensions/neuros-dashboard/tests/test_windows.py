"""Which of ROS's graphical tools can run here."""

from __future__ import annotations

from pathlib import Path

import pytest
from neuros_dashboard.windows import find_tool, has_display

from neuros.errors import EnvironmentFault

NO_ENGINE = {"DOCKER_HOST": "unix:///nowhere.sock"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    program = tmp_path / "rqt_graph"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    return tmp_path


def test_a_tool_on_the_path_runs_where_there_is_a_display(folder: Path) -> None:
    environ = {"PATH": str(folder), "DISPLAY": ":1", **NO_ENGINE}
    assert find_tool("rqt_graph", environ) == str(folder / "rqt_graph")


def test_without_a_display_no_tool_runs(folder: Path) -> None:
    with pytest.raises(EnvironmentFault, match="rqt_graph needs a display"):
        find_tool("rqt_graph", {"PATH": str(folder)})
    assert has_display({"WAYLAND_DISPLAY": "wayland-0"})


def test_what_is_nowhere_is_told_with_both_places(folder: Path) -> None:
    why = "rviz2 is not on PATH, and there is no Docker engine for the image neuros_tools"
    with pytest.raises(EnvironmentFault, match=why):
        find_tool("rviz2", {"PATH": str(folder), "DISPLAY": ":1", **NO_ENGINE})
