"""The layout of the dashboard in a project file: kept with the project, unknown to its nodes."""

from __future__ import annotations

import json
from pathlib import Path

from neuros.project.load import load_project
from neuros.project.model import Folders
from neuros.project.split import node_file_to_json, project_to_json, split
from neuros.viewers.web import project_view

RING = Path(__file__).parents[1] / "viewers" / "dashboard" / "ring"
PANELS = json.loads((RING / "project.json").read_text())["dashboard"]


def test_a_page_gets_the_layout_and_what_each_output_can_be_drawn_as() -> None:
    told = project_view(load_project(RING, workspace=RING).project, ["ring"])
    assert told["dashboard"] == PANELS
    (source,) = told["sources"]
    assert (source["array"], source["is_spikes"], source["is_image"]) == ("data", False, False)


def test_the_expanded_project_has_it_and_a_node_has_not(tmp_path: Path) -> None:
    project = load_project(RING, workspace=RING).project
    expanded = tmp_path / "project.json"
    expanded.write_text(json.dumps(project_to_json(project)))
    again = load_project(expanded, workspace=RING, folder=RING).project
    assert again.dashboard == PANELS
    for file in split(project, lambda _: Folders(tmp_path, tmp_path, tmp_path)):
        assert "dashboard" not in node_file_to_json(file)
