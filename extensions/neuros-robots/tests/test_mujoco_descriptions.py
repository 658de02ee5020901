"""Robots in MJCF, URDF and SDF in the MuJoCo node, and drives that the node file declares."""

from __future__ import annotations

from pathlib import Path

import pytest
from simulated_node import SimulatedNode
from std_msgs.msg import String

from neuros.errors import ModelError
from neuros.simulators.mujoco import MuJoCo

FLOAT, FLOATS = "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray"
MOMENTS = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
URDF = f"""
<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><mass value="1"/>{MOMENTS}</inertial></link>
  <joint name="shoulder" type="continuous">
    <parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
  </joint>
  <gazebo/>
</robot>
"""
SDF = """
<sdf version="1.9">
  <model name="arm">
    <link name="upper">
      <inertial><mass>1</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial>
      <sensor name="imu" type="imu"/>
    </link>
    <joint name="shoulder" type="continuous">
      <parent>world</parent><child>upper</child><axis><xyz>0 0 1</xyz></axis>
    </joint>
    <plugin filename="a" name="b"/>
  </model>
</sdf>
"""
MJCF = """
<mujoco>
  <worldbody>
    <body name="upper">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint name="shoulder" axis="0 0 1"/>
    </body>
  </worldbody>
</mujoco>
"""
IMU = {"sensor": "imu", "element": "upper", "rate": 50}
SPIN = {"joint": "shoulder", "drive": "velocity", "kv": 100}


def simulated(folder: Path, name: str, text: str, drive=SPIN, type_=FLOAT):
    (folder / name).write_text(text, "utf-8")
    outputs = {"imu": ("sensor_msgs/msg/Imu", IMU)}
    node = SimulatedNode(outputs, {"turn": (type_, drive)}, folder)
    return MuJoCo(node, name), node


@pytest.mark.parametrize(
    ("name", "text"),
    [("arm.urdf", URDF), ("arm.sdf", SDF), ("arm.xml", MJCF), ("arm.mjcf", MJCF)],
)
def test_a_robot_of_any_format_is_driven_and_measured_from_the_node_file(
    tmp_path: Path, name: str, text: str
) -> None:
    sim, _ = simulated(tmp_path, name, text)
    from std_msgs.msg import Float64

    sim.command("turn", Float64(data=2.0))
    for _ in range(50):
        sim.step_to_next()
        packet = sim.read("imu")
    assert packet.angular_velocity.z == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize(("name", "text"), [("arm.urdf", URDF), ("arm.sdf", SDF)])
def test_what_is_not_taken_over_is_one_warning(tmp_path: Path, name: str, text: str) -> None:
    _, node = simulated(tmp_path, name, text)
    (warning,) = node.log.warnings
    assert warning.startswith(f"{name}: not converted")
    assert f"{name}:" in warning.splitlines()[1]


def test_a_position_drive_goes_where_it_is_told_with_limited_force(tmp_path: Path) -> None:
    drive = {"joints": ["shoulder"], "drive": "position", "kp": 50, "kv": 20, "force_limit": 3}
    sim, _ = simulated(tmp_path, "arm.urdf", URDF, drive, FLOATS)
    from std_msgs.msg import Float64MultiArray

    sim.command("turn", Float64MultiArray(data=[1.0]))
    sim.step_synchronous(1)
    assert sim.data.actuator("shoulder").force[0] == 3
    for _ in range(300):
        sim.step_to_next()
        sim.read("imu")
    assert sim.data.joint("shoulder").qpos[0] == pytest.approx(1.0, abs=0.01)


def test_a_motor_applies_what_it_is_told(tmp_path: Path) -> None:
    sim, _ = simulated(tmp_path, "arm.urdf", URDF, {"joint": "shoulder", "drive": "motor"})
    sim.actuate("shoulder", 0.5)
    sim.step_synchronous(1)
    assert sim.data.actuator("shoulder").force[0] == 0.5


@pytest.mark.parametrize(
    ("drive", "problem"),
    [
        ({"joint": "shoulder"}, "/drive: None is not one of position, velocity, motor"),
        ({"joint": "shoulder", "drive": "position"}, "/kp: missing: a position drive needs it"),
        ({"joint": "shoulder", "drive": "motor", "kv": 1}, "/kv: a motor drive has no kv"),
        ({**SPIN, "kv": -1}, "/kv: -1 is not a positive number"),
        ({**SPIN, "joint": "sholder"}, "no joint 'sholder' (did you mean 'shoulder'?)"),
        ({"actuator": "x", "kv": 1}, "/kv: unknown key"),
    ],
)
def test_a_wrong_drive_is_named_by_its_key(tmp_path: Path, drive, problem: str) -> None:
    with pytest.raises(ModelError) as caught:
        simulated(tmp_path, "arm.urdf", URDF, drive)
    assert problem in str(caught.value)


def test_joints_are_driven_by_a_message_that_the_plugin_reads(tmp_path: Path) -> None:
    sim, _ = simulated(tmp_path, "arm.urdf", URDF, type_="std_msgs/msg/String")
    sim.actuate("shoulder", 1.5)
    sim.step_synchronous(10)
    assert sim.data.qvel[0] > 0.5
    with pytest.raises(ModelError, match=r"a String is no command by itself: .*'shoulder'"):
        sim.command("turn", String(data="left"))


def test_a_joint_that_has_an_actuator_is_not_driven_twice(tmp_path: Path) -> None:
    driven = MJCF.replace(
        "</mujoco>",
        '<actuator><motor name="shoulder" joint="shoulder"/></actuator></mujoco>',
    )
    with pytest.raises(ModelError, match="has an actuator 'shoulder': name that with 'actuator'"):
        simulated(tmp_path, "arm.xml", driven)


def test_another_kind_of_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"model format \'txt\': choose one of xml, mjcf, "):
        simulated(tmp_path, "arm.txt", MJCF)


def test_everything_wrong_with_a_description_is_said_with_its_line(tmp_path: Path) -> None:
    broken = SDF.replace("0 0 1", "0 0 0").replace("<mass>1", "<mass>x")
    with pytest.raises(ModelError) as caught:
        simulated(tmp_path, "arm.sdf", broken)
    first, second = str(caught.value).splitlines()
    assert "arm.sdf:5:" in first
    assert "'x' is not a number" in first
    assert "arm.sdf:9:" in second
    assert "the axis has no direction" in second


def test_a_world_is_found_in_the_folders_that_gazebo_would_look_in(tmp_path: Path) -> None:
    (tmp_path / "gazebo/world").mkdir(parents=True)
    (tmp_path / "gazebo/world/arm.sdf").write_text(SDF, "utf-8")
    environment = {"GZ_SIM_RESOURCE_PATH": str(tmp_path / "gazebo")}
    node = SimulatedNode(folder=tmp_path, environment=environment)
    assert MuJoCo(node, "world/arm.sdf").model.nbody == 2
