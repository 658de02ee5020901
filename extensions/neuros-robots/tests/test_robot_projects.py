"""``neuros new --robot``: a project around any robot, which is valid and runs."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import mujoco
import pytest
from describing import CUBE
from launching import launch

from neuros.cli.main import main
from tests.corpus.fetching import Unreached, unpacked

INERTIAL = '<inertial><mass value="{}"/><inertia ixx="{}" iyy="{}" izz="{}"/></inertial>'
HEAVY, LIGHT = INERTIAL.format(5, 0.1, 0.1, 0.1), INERTIAL.format(0.2, 0.001, 0.001, 0.001)
WHEEL = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
SENSORS = (
    '<sensor name="scan" type="gpu_lidar"><lidar><scan><horizontal><samples>181</samples>'
    "<min_angle>-2</min_angle><max_angle>2</max_angle></horizontal></scan><range><max>5</max>"
    '</range></lidar></sensor><sensor name="imu" type="imu"/><sensor name="eye" type="camera">'
    "<camera><image><width>64</width><height>48</height></image></camera></sensor>"
)


def part(name: str, kind: str, place: str, limit: str = "", inside: str = LIGHT) -> str:
    return (
        f'<link name="{name}">{inside}</link><joint name="{name}_joint" type="{kind}">'
        f'<parent link="base"/><child link="{name}"/><origin xyz="{place}"/><axis xyz="0 1 0"/>'
        f"{limit}</joint>"
    )


ROBOT = (
    f'<robot name="car"><link name="base">{HEAVY}<visual><geometry>'
    '<mesh filename="cube.obj" scale=".1 .1 .1"/></geometry></visual></link>'
    + part("left", "continuous", "0 0.2 0", inside=LIGHT + WHEEL)
    + part("right", "continuous", "0 -0.2 0", inside=LIGHT + WHEEL)
    + part("ball", "fixed", "0.3 0 0", inside=LIGHT + WHEEL)
    + part("neck", "revolute", "0 0 0.2", '<limit lower="-1" upper="1" effort="9" velocity="1"/>')
    + part("bolt", "revolute", "0 0 0.1", '<limit lower="0" upper="0" effort="9" velocity="1"/>')
    + part(
        "mirror",
        "revolute",
        "0 0 0.3",
        '<limit lower="-1" upper="1" effort="9" velocity="1"/><mimic joint="neck_joint"/>',
    )
    + f'<gazebo reference="base">{SENSORS}</gazebo></robot>'
)


@pytest.fixture(autouse=True)
def car(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cube.obj").write_text(CUBE, "ascii")
    file = tmp_path / "car.urdf"
    file.write_text(ROBOT, "utf-8")
    return file


def declared(folder: Path) -> tuple[Any, dict[str, Any], list[str]]:
    """The model of a project, the sensors of its robot by name, and the names of all nodes."""
    project = json.loads((folder / "project.json").read_text("utf-8"))
    outputs = {row["name"]: row["mujoco"] for row in project["nodes"][0]["outputs"]}
    model = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    return model, outputs, [node["name"] for node in project["nodes"]]


def test_a_robot_becomes_a_project_that_is_valid(car: Path, capsys: Any) -> None:
    assert main(["new", "--robot", "car.urdf", "--base", "free"]) == 0
    said = capsys.readouterr().out
    assert "base: free (base)\n" in said
    assert "velocity drives: left_joint, right_joint\nposition drives: neck_joint\n" in said
    assert "made car; the next command: neuros launch car --dashboard\n" in said
    car.unlink()
    (car.parent / "cube.obj").unlink()
    assert main(["validate", "car"]) == 0  # the project is complete
    model, outputs, nodes = declared(car.parent / "car")
    assert nodes == ["robot", "brain"]
    assert [model.actuator(index).name for index in range(model.nu)] == [
        *("left_joint", "right_joint", "neck_joint"),
    ]
    drives = outputs["joints"]["element"]
    assert sorted(drives) == ["left_joint", "neck_joint", "right_joint"]
    assert outputs["base_imu"] == {"sensor": "imu", "element": "base/imu", "rate": 50}
    assert outputs["base_eye"]["width"] == 64
    lidar = {"sensor": "lidar", "element": "base/scan", "beams": 181, "rate": 10}
    angles = {"angle_min": -2.0, "angle_max": 2.0, "range_max": 5.0}
    assert outputs["base_scan"] == lidar | angles
    assert outputs["pose"]["element"] == "base"


def test_a_free_robot_stands_on_the_floor_and_drives(car: Path) -> None:
    assert main(["new", "mine", "--robot", "car.urdf", "--base", "free"]) == 0
    model, _, _ = declared(car.parent / "mine")
    data = mujoco.MjData(model)
    data.ctrl[:2] = 2.0
    mujoco.mj_step(model, data, nstep=1000)
    assert data.body("base").xpos[2] == pytest.approx(0.1, abs=0.01)
    assert data.joint("left_joint").qvel[0] == pytest.approx(2.0, abs=0.4)  # one part drags
    assert 0.2 < data.body("base").xpos[0] < 0.4


def test_a_held_robot_has_no_floor_and_a_servo_goes_where_it_is_told(car: Path) -> None:
    assert main(["new", "mine", "--robot", "car.urdf", "--base", "fixed"]) == 0
    model, outputs, _ = declared(car.parent / "mine")
    assert "pose" not in outputs
    data = mujoco.MjData(model)
    data.actuator("neck_joint").ctrl[0] = 0.4
    mujoco.mj_step(model, data, nstep=1000)
    assert data.joint("neck_joint").qpos[0] == pytest.approx(0.4, abs=0.02)


def test_every_joint_has_the_drive_that_is_chosen(car: Path) -> None:
    choice = ["--base", "fixed", "--drive", "motor"]
    assert main(["new", "mine", "--robot", "car.urdf", *choice]) == 0
    model, _, _ = declared(car.parent / "mine")
    assert not model.actuator_biasprm.any()
    assert main(["new", "bare", "--robot", "car.urdf", "--base", "fixed", "--drive", "none"]) == 0
    model, _, nodes = declared(car.parent / "bare")
    assert (model.nu, nodes) == (0, ["robot"])
    assert main(["validate", "bare"]) == 0


def test_what_the_file_cannot_know_is_asked_for(car: Path, monkeypatch: Any, capsys: Any) -> None:
    assert main(["new", "--robot", "car.urdf"]) == 2
    assert "does not say whether 'base' moves: --base free (" in capsys.readouterr().err
    assert not (car.parent / "car").exists()
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda question: "free")
    assert main(["new", "--robot", "car.urdf"]) == 0
    assert "base: free (base)" in capsys.readouterr().out


def test_what_the_file_says_is_not_asked_for(car: Path) -> None:
    car.write_text(ROBOT.replace('"base"', '"world"'), "utf-8")
    assert main(["new", "held", "--robot", "car.urdf"]) == 0
    sdf = '<sdf version="1.9"><model name="m"><link name="l"/></model></sdf>'
    (car.parent / "ball.sdf").write_text(sdf, "utf-8")
    assert main(["new", "--robot", "ball.sdf"]) == 0
    assert declared(car.parent / "ball")[1]["pose"]["element"] == "l"


MJCF = """\
<mujoco model="two">
  <compiler meshdir="parts"/>
  <asset><mesh name="m" file="cube.obj" scale=".1 .1 .1"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="car" pos="0 0 1"><freejoint/><geom type="mesh" mesh="m"/><site name="imu"/>
      <body name="arm"><joint axis="0 1 0" range="-60 60"/><geom size=".1"/></body>
      <body><joint name="wrist" axis="0 1 0"/><geom size=".1"/></body></body>
  </worldbody>
  <actuator><position name="w" joint="wrist" kp="5"/></actuator>
  <sensor><gyro name="imu/gyro" site="imu"/></sensor>{}
</mujoco>"""


@pytest.mark.parametrize("name", ["two.xml", "two.mjcf"])
def test_a_robot_of_mujocos_keeps_what_it_has(car: Path, name: str, capsys: Any) -> None:
    (car.parent / "parts").mkdir()
    (car.parent / "cube.obj").rename(car.parent / "parts/cube.obj")
    (car.parent / name).write_text(MJCF.format(""), "utf-8")
    assert main(["new", "--robot", name]) == 0
    assert "base: free (car)\n" in capsys.readouterr().out
    (car.parent / "parts/cube.obj").unlink()
    assert main(["validate", "two"]) == 0
    model, outputs, nodes = declared(car.parent / "two")
    assert nodes == ["robot", "brain"]
    assert [model.actuator(index).name for index in range(model.nu)] == ["w", "arm/joint"]
    assert outputs["joints"]["element"] == ["wrist", "arm/joint"]
    assert outputs["imu"]["element"] == "imu"
    assert model.body("car").pos[2] == 1  # it has a floor of its own

    key = '<keyframe><key name="home" ctrl="0.5"/></keyframe>'
    (car.parent / "parts/cube.obj").write_text(CUBE, "ascii")
    (car.parent / name).write_text(MJCF.format(key), "utf-8")
    assert main(["new", "posed", "--robot", name]) == 0
    model, outputs, _ = declared(car.parent / "posed")
    assert (model.nu, model.nkey, outputs["joints"]["element"]) == (1, 1, ["wrist"])


def test_xml_that_is_no_robot_is_named(car: Path, capsys: Any) -> None:
    for text, problem in (
        ("<html/>", "robot.xml:1:1: html: a robot is <mujoco>, <robot> (URDF) or <sdf>"),
        ("<mujoco>\n<bogus/></mujoco>", "robot.xml:2:1: /: XML Error: Schema violation"),
    ):
        (car.parent / "robot.xml").write_text(text, "utf-8")
        assert main(["new", "--robot", "robot.xml"]) == 3
        assert problem in capsys.readouterr().err
    (car.parent / "robot.xml").write_text(ROBOT, "utf-8")
    assert main(["new", "--robot", "robot.xml"]) == 2
    assert "does not say whether 'base' moves" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], "name a folder for the project, or a robot with --robot FILE"),
        (["mine", "--base", "free"], "--base and --drive belong to --robot FILE"),
        (["--robot", "none.urdf"], "--robot none.urdf: there is no such file"),
        (["--robot", "cube.obj"], "model format 'obj': choose one of "),
        (["car.urdf", "--robot", "car.urdf"], "car.urdf exists already: name another folder"),
    ],
)
def test_what_cannot_be_meant_is_said(arguments: list[str], problem: str, capsys: Any) -> None:
    assert main(["new", *arguments]) == 2
    assert problem in capsys.readouterr().err


def test_a_wrong_file_leaves_no_folder(car: Path, capsys: Any) -> None:
    car.write_text(ROBOT.replace('"continuous"', '"rolling"'), "utf-8")
    assert main(["new", "--robot", "car.urdf", "--base", "free"]) == 3
    assert "'rolling' is not a type of joint" in capsys.readouterr().err
    assert sorted(path.name for path in car.parent.iterdir()) == ["car.urdf", "cube.obj"]


def test_it_runs(car: Path) -> None:
    text = ROBOT.replace(SENSORS, SENSORS.partition('<sensor name="eye"')[0])  # needs no OpenGL
    car.write_text(text, "utf-8")
    assert main(["new", "--robot", "car.urdf", "--base", "free"]) == 0
    run = launch(car.parent / "car", "--duration", "2sim", cwd=car.parent)
    assert run.exit_code == 0, run.output
    assert run.connection("brain.command -> robot.command")["consumed"] > 0


@pytest.mark.parametrize(
    ("package", "name", "base"),
    [
        ("gym-ignition-models", "gym_ignition_models/panda/panda.urdf", "fixed"),
        ("jvrc-description", "jvrc_description/urdf/jvrc1.urdf", "free"),
        ("robot-properties-fingers", "robot_properties_fingers/urdf/finger.urdf", "fixed"),
    ],
)
def test_a_public_robot_becomes_a_project(
    package: str, name: str, base: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try:
        folder = unpacked(package)
    except Unreached as error:
        pytest.skip(str(error))
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(folder))
    assert main(["new", "mine", "--robot", str(folder / name), "--base", base]) == 0
    assert main(["validate", "mine"]) == 0
    model, _, _ = declared(tmp_path / "mine")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=200)
    assert not data.warning.number.any()
