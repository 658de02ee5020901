"""The configuration of RViz that a project gets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from neuros_dashboard.windows import rviz_configuration
from ruamel.yaml import YAML

from neuros.project.model import Connection, Node, Port, Project

SCAN, POSE, TEXT = (
    "sensor_msgs/msg/LaserScan",
    "geometry_msgs/msg/PoseStamped",
    "std_msgs/msg/String",
)


def project() -> Project:
    outputs = (Port("scan", SCAN), Port("text", TEXT), Port("goal", POSE, "/goal"))
    robot = Node("robot", "c", Path("r.py"), outputs=outputs)
    brain = Node("brain", "c", Path("b.py"), inputs=(Port("scan", SCAN), Port("text", TEXT)))
    connections = (
        Connection("robot", "scan", "brain", "scan", 0),
        Connection("robot", "scan", "brain", "again", 0, index=1),
        Connection("robot", "text", "brain", "text", index=2),
    )
    return Project("p", (robot, brain), connections, Path("project.json"))


def displays() -> dict[str, Any]:
    loaded = YAML(typ="safe").load(rviz_configuration(project()))
    return {each["Name"]: each for each in loaded["Visualization Manager"]["Displays"]}


def test_each_output_that_rviz_can_show_has_one_display() -> None:
    assert list(displays()) == ["Grid", "TF", "robot.scan", "/goal"]


def test_a_display_listens_where_the_connection_is_and_holds_up_nobody() -> None:
    scan = displays()["robot.scan"]
    assert scan["Class"] == "rviz_default_plugins/LaserScan"
    assert scan["Topic"]["Value"] == "/neuros/robot/scan/brain/scan/data"
    assert scan["Topic"]["Reliability Policy"] == "Best Effort"
    assert displays()["/goal"]["Topic"]["Value"] == "/goal"
