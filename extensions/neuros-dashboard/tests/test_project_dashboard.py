"""The layout of the dashboard in a project file: kept with the project, unknown to its nodes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from neuros_dashboard.web import project_view

from neuros.api.loading import load_with_messages
from neuros.errors import ProjectError
from neuros.project.load import load_project
from neuros.project.model import Folders
from neuros.project.split import node_file_to_json, project_to_json, split

RING = Path(__file__).with_name("ring")
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


def test_fields_of_the_project_s_own_messages_are_checked_before_they_are_built(
    tmp_path: Path,
) -> None:
    package = tmp_path / "workspace" / "arm_msgs"
    (package / "msg").mkdir(parents=True)
    (package / "package.xml").write_text(
        '<package format="3"><name>arm_msgs</name><version>1.0.0</version>'
        '<description>d</description><maintainer email="a@b.org">a</maintainer>'
        "<license>MIT</license><depend>geometry_msgs</depend><depend>std_msgs</depend></package>"
    )
    (package / "msg" / "Joint.msg").write_text("float64[] angles  # rad\n")
    (package / "msg" / "Arm.msg").write_text(
        "uint8 OPEN = 1\nstd_msgs/Header header\nJoint[<=7] joints\ngeometry_msgs/Point tip\n"
        "float32[3] load\nstring<=8 state ready\n"
    )
    fields = ["joints[0].angles", "load", "joint", "OPEN", "state"]
    panels = [{"panel": "activity", "output": "arm.state", "field": field} for field in fields]
    arm = {
        "name": "arm",
        "container": "neuros_python",
        "plugin": "arm.py",
        "outputs": [{"name": "state", "type": "arm_msgs/msg/Arm"}],
    }
    (tmp_path / "arm.py").touch()
    project = tmp_path / "project.json"
    project.write_text(
        json.dumps({"nodes": [arm], "connections": [], "dashboard": {"panels": panels}})
    )
    with pytest.raises(ProjectError) as error:
        load_with_messages(project, reads_plugins=False)
    has = "it has 'header', 'joints', 'tip', 'load', 'state'"
    assert [(p.pointer[-7:], p.text, p.hint) for p in error.value.problems] == [
        ("2/field", "arm_msgs/msg/Arm has no field 'joint'", f"did you mean 'joints'? {has}"),
        ("3/field", "arm_msgs/msg/Arm has no field 'OPEN'", has),
        ("4/field", "'state' of arm_msgs/msg/Arm is string, not an array of numbers", ""),
    ]


def test_a_panel_of_earlier_versions_is_left_out_with_a_warning(tmp_path: Path) -> None:
    panel = {"panel": "series", "fields": [{"output": "ring.rates", "field": "data[0]"}]}
    for name in ("ring.py", "eyes.py"):
        (tmp_path / name).write_text((RING / name).read_text())
    told = json.loads((RING / "project.json").read_text()) | {"dashboard": {"panels": [panel]}}
    (tmp_path / "project.json").write_text(json.dumps(told))
    (warning,) = load_project(tmp_path, workspace=tmp_path).warnings
    assert (warning.pointer, warning.text, warning.hint) == (
        "/dashboard/panels/0",
        "the panel 'series' has no effect",
        "plot numbers with --viewer foxglove",
    )
