"""``--set``: what it can change, and that it is judged like the files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from neuros.errors import ProjectError
from neuros.project.load import load_project
from neuros.project.model import Budgets, Project

PROJECT = {
    "nodes": [
        "robot.json",
        {
            "name": "snn", "container": "neuros_nest", "plugin": "p.py",
            "inputs": [{"name": "imu", "type": "sensor_msgs/msg/Imu"}],
        },
    ],
    "connections": [
        {"source_node": "robot", "source_output": "imu", "destination_node": "snn",
         "destination_input": "imu", "discard_limit": 0},
    ],
}  # fmt: skip
ROBOT = {
    "name": "robot", "container": "neuros_mujoco", "plugin": "p.py",
    "environment": {"SEED": "1"},
    "outputs": [{"name": "imu", "type": "sensor_msgs/msg/Imu",
                 "mujoco": {"sensor": "imu", "element": "imu", "rate": 50}}],
}  # fmt: skip


@pytest.fixture
def file(tmp_path: Path) -> Path:
    for name, content in (("project.json", PROJECT), ("robot.json", ROBOT)):
        (tmp_path / name).write_text(json.dumps(content, indent=2))
    (tmp_path / "p.py").touch()
    return tmp_path / "project.json"


def load(file: Path, *overrides: str) -> Project:
    return load_project(file, workspace=file.parent, overrides=overrides).project


def problems(file: Path, *overrides: str) -> list[str]:
    with pytest.raises(ProjectError) as error:
        load(file, *overrides)
    return [str(problem) for problem in error.value.problems]


@pytest.mark.parametrize("value", ["7", "1.50", "true", '{"a": 1}', "two words", "=", "null"])
def test_a_value_in_the_environment_is_always_a_text(file: Path, value: str) -> None:
    project = load(file, f"nodes.robot.environment.SEED={value}")
    assert project.node("robot").environment == {"SEED": value}


def test_what_is_not_there_yet_is_made(file: Path) -> None:
    project = load(file, "nodes.snn.environment.A=1", "nodes.snn.environment.B.C=2")
    assert project.node("snn").environment == {"A": "1", "B.C": "2"}


def test_paths_start_at_the_project(file: Path) -> None:
    project = load(file, "nodes.robot.environment.MODEL=#p.py")
    assert project.node("robot").environment["MODEL"] == str(file.parent / "p.py")


def test_a_value_is_json_elsewhere(file: Path) -> None:
    project = load(file, "connections.robot.imu.snn.imu.queue_size=4")
    assert project.connections[0].queue_size == 4


def test_what_is_no_json_is_a_text(file: Path) -> None:
    assert load(file, "nodes.snn.container=my_image").node("snn").container == "my_image"


def test_nothing_removes_the_key(file: Path) -> None:
    project = load(
        file,
        "connections.robot.imu.snn.imu.discard_limit=",
        "nodes.robot.environment.SEED=",
        "nodes.robot.environment.NEVER=",
        "nodes.snn.environment.NEVER=",
    )
    assert project.connections[0].discard_limit is None
    assert project.node("robot").environment == {}


def test_ports_go_by_their_names(file: Path) -> None:
    project = load(file, "nodes.robot.outputs.imu.mujoco.rate=100")
    assert project.node("robot").output("imu").mujoco["rate"] == 100


def test_budgets_are_set_and_removed(file: Path) -> None:
    budgets = load(
        file,
        "budgets.real_time_factor=0.5",
        "budgets.tick_error_ms=5",
        "budgets.lost_packets.robot.imu -> snn.imu=3",
        "budgets.tick_error_ms=",
    ).budgets
    assert budgets == Budgets({"robot.imu -> snn.imu": 3}, 0.5, None)


def test_they_apply_in_their_order(file: Path) -> None:
    project = load(file, "nodes.snn.container=a", "nodes.snn.container=b")
    assert project.node("snn").container == "b"


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("nodes.robt.plugin=p.py",
         "7: /nodes/robt: there is no node 'robt' (did you mean 'robot'?)"),
        ("connections.robot.imu.snn.im.queue_size=1",
         "13: /connections/robot.imu.snn.im: there is no connection 'robot.imu.snn.im'"
         " (did you mean 'robot.imu.snn.imu'?)"),
        ("node.robot.plugin=p.py",
         "1: /: must begin with 'nodes.', 'connections.' or 'budgets.' (did you mean 'nodes'?)"),
        ("nodes.robot=1", "12: /nodes: is not of the form (nodes.NAME.KEY=VALUE)"),
        ("nodes.robot.plugin", "19: /nodes: is not of the form (nodes.NAME.KEY=VALUE)"),
        ("connections.robot.imu.snn.imu=1",
         "30: /connections: is not of the form (connections.SRC.OUT.DST.IN.KEY=VALUE)"),
        ("nodes.robot.name.first=1",
         "18: /name/first: 'first' cannot be set: there is no object around it"),
        ("nodes.robot.outputs.odom.type=x", "21: /outputs/odom: there is no 'odom' in /outputs"),
        ("budgets=1",
         "8: /budgets: is not of the form"
         " (budgets.KEY=VALUE or budgets.lost_packets.SRC.OUT -> DST.IN=VALUE)"),
        ("budgets.real_time_factr=1",
         "25: /budgets/real_time_factr: unknown key 'real_time_factr'"
         " (did you mean 'real_time_factor'?)"),
        ("budgets.lost_packets.robot.im -> snn.imu=1",
         "42: /budgets/lost_packets/robot.im -> snn.imu: there is no connection"
         " 'robot.im -> snn.imu' (did you mean 'robot.imu -> snn.imu'?)"),
        ("connections.robot.imu.snn.imu.discard_limit=-1",
         "45: /connections/0/discard_limit: must be at least 0, but is -1"),
        ("nodes.snn.colour=red", "18: /nodes/1/colour: unknown key 'colour'"),
        ("nodes.robot.plugin=q.py",
         "20: /plugin: there is no file 'q.py' (did you mean 'p.py'?)"),
        ('nodes.robot.environment={"A": 1, "A": 2}',
         "34: /environment/A: the key 'A' occurs twice (first in line 1)"),
    ],
)  # fmt: skip
def test_mistakes_are_located_in_the_override(file: Path, override: str, problem: str) -> None:
    assert problems(file, override) == [f"--set {override}: character {problem}"]


def test_mistakes_come_together_with_those_of_the_files(file: Path) -> None:
    file.write_text(file.read_text().replace('"plugin"', '"plugn"'))
    found = problems(file, "nodes.snn.container=1", "nodes.other.container=x")
    assert len(found) == 4


def test_removing_what_is_needed_is_reported_at_the_file(file: Path) -> None:
    (problem,) = problems(file, "nodes.robot.plugin=")
    assert problem.endswith(
        "robot.json:1:1: /: needs exactly one of 'plugin', 'network' or 'policy'"
    )
