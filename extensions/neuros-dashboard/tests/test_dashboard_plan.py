"""What a page is told of a project."""

from __future__ import annotations

import json
from pathlib import Path

from neuros_dashboard.web import project_view

from neuros.project.load import load_project

BOOL = "std_msgs/msg/Bool"
NODE = {
    "name": "rover",
    "container": "neuros_python",
    "plugin": "rover.py",
    "inputs": [{"name": "stop", "type": BOOL, "external_topic": "halt"}],
    "outputs": [{"name": "ok", "type": BOOL, "external_topic": "fine"}],
}


def test_external_topics_are_shown_by_the_names_that_they_have_on_the_graph(tmp_path: Path) -> None:
    (tmp_path / "rover.py").write_text("")
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [NODE]}))
    named = {"namespace": "/left", "remap": ["fine:=/all_well"]}
    project = load_project(tmp_path, workspace=tmp_path, **named).project

    told = project_view(project, ["rover"])

    assert [(each["full"], each["title"]) for each in told["topics"]] == [
        ("/left/halt", "/left/halt -> rover.stop"),
        ("/all_well", "rover.ok -> /all_well"),
    ]
    assert [each["title"] for each in told["sources"]] == ["rover.ok", "rover./left/halt"]
