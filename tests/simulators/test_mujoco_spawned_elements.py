"""A declaration may name an element that the plugin spawns: load a world, spawn a robot, step."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from launching import BACKENDS, launch
from simulated_node import WORLD, SimulatedNode, imu, stamp_ns
from std_msgs.msg import Float64, Float64MultiArray

from neuros.errors import ModelError
from neuros.simulators.mujoco import MuJoCo

PUBLISHED = Path(__file__).parents[1] / "published" / "whiskeye"
FLOAT, FLOATS = "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray"
ROBOT = """
<mujoco model="robot">
  <worldbody>
    <body name="body" pos="0 0 1">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint name="turn" axis="0 0 1"/>
      <site name="imu"/>
      <camera name="eye" xyaxes="1 0 0 0 0 1"/>
      <body name="arm">
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <joint name="shoulder" axis="0 0 1"/>
      </body>
    </body>
  </worldbody>
  <actuator><velocity name="turn" joint="turn" kv="1000"/></actuator>
</mujoco>
"""
CUP = """
<mujoco><worldbody><body name="cup" pos="0 0 5"><freejoint/><geom size=".1"/><site name="top"/>
</body></worldbody></mujoco>
"""
JOINTS = "sensor_msgs/msg/JointState"


def simulation(folder: Path, outputs=None, inputs=None, spawned=("robot",)):
    (folder / "robot.xml").write_text(ROBOT, "utf-8")
    (folder / "cup.xml").write_text(CUP, "utf-8")
    node = SimulatedNode(outputs, inputs, folder)
    sim = MuJoCo(node, WORLD)
    for name in spawned:
        sim.spawn_entity("robot.xml", (0, 0, 0), name)
    return node, sim


def turning(element: str):
    return {"turn": (FLOAT, {"actuator": element})}


def test_sensor_and_actuator_of_a_spawned_robot_work_as_those_of_the_world(tmp_path: Path) -> None:
    outputs = {"imu": imu("robot/imu"), "world": imu("box_imu")}
    _, sim = simulation(tmp_path, outputs, turning("robot/turn"))
    sim.command("turn", Float64(data=2.0))
    for count in range(1, 26):
        sim.step_to_next()
        packet = sim.read("imu")
        assert sim.read("world") is not None
        assert stamp_ns(packet) == count * 20_000_000
    assert packet.header.frame_id == "robot/imu"
    assert packet.angular_velocity.z == pytest.approx(2.0, abs=0.01)
    assert packet.linear_acceleration.z == pytest.approx(9.81)


def test_a_drive_is_given_to_the_joint_that_is_spawned(tmp_path: Path) -> None:
    drive = {"joints": ["turn", "robot/shoulder"], "drive": "velocity", "kv": 100.0}
    states = (JOINTS, {"sensor": "joint_states", "element": "robot/shoulder", "rate": 50})
    _, sim = simulation(tmp_path, {"states": states}, {"go": (FLOATS, drive)})
    sim.command("go", Float64MultiArray(data=[0.0, 3.0]))
    for _ in range(5):
        sim.step_to_next()
        (speed,) = sim.read("states").velocity
    assert speed == pytest.approx(3.0, abs=0.01)
    assert sim.model.nu == 3 + 1 + 2  # of the world, of the robot, of the node file


@pytest.mark.needs("OpenGL")
def test_a_camera_of_a_spawned_robot_sees(tmp_path: Path) -> None:
    keys = {"sensor": "camera", "element": "robot/eye", "rate": 50, "width": 1000, "height": 8}
    node, sim = simulation(tmp_path, {"image": ("sensor_msgs/msg/Image", keys)})
    sim.step_to_next()
    image = sim.read("image")
    node.close()
    assert (image.width, image.height, image.header.frame_id) == (1000, 8, "robot/eye")
    assert any(image.data)


def test_it_steps_itself_with_a_spawned_robot(tmp_path: Path) -> None:
    node, sim = simulation(tmp_path, {"imu": imu("robot/imu")})
    sim.run_asynchronous(None)
    node.wait_until(lambda: len(node.sent) >= 3)
    sim.close()
    assert [stamp_ns(sent["imu"]) for sent in node.sent[:3]] == [20_000_000, 40_000_000, 60_000_000]
    assert not node.failures


def test_every_entity_brings_its_own(tmp_path: Path) -> None:
    outputs = {name: imu(f"{name}/imu") for name in ("left", "right")}
    _, sim = simulation(tmp_path, outputs, turning("right/turn"), spawned=("left", "right"))
    sim.command("turn", Float64(data=1.0))
    sim.step_synchronous(20)
    assert sim.read("left").angular_velocity.z == 0
    assert sim.read("right").angular_velocity.z > 0.1


def test_the_name_of_an_entity_may_lie_in_that_of_another(tmp_path: Path) -> None:
    _, sim = simulation(tmp_path, {"imu": imu("robot/cup/top")})
    sim.spawn_entity("cup.xml", (0, 0, 0), "robot/cup")
    sim.step_to_next()
    assert sim.read("imu").linear_acceleration.z == pytest.approx(0, abs=1e-9)  # it falls


@pytest.mark.parametrize(
    ("outputs", "inputs", "problem"),
    [
        (
            {"imu": imu("robot/imuu")},
            {},
            "/outputs/0/mujoco/element: the model has no site or body 'robot/imuu' "
            "(did you mean 'robot/imu'?)",
        ),
        (
            {"states": (JOINTS, {"sensor": "joint_states", "element": "robot/imu", "rate": 50})},
            {},
            "/outputs/0/mujoco/element: the model has no joint 'robot/imu' "
            "(did you mean 'robot/turn'?)",
        ),
        (
            {},
            turning("robot/turning"),
            "/inputs/0/mujoco/actuator: the model has no actuator 'robot/turning' "
            "(did you mean 'robot/turn'?)",
        ),
        (
            {},
            {"turn": (FLOAT, {"joint": "robot/should", "drive": "motor"})},
            "/inputs/0/mujoco/joint: the model has no joint 'robot/should' "
            "(did you mean 'robot/shoulder'?)",
        ),
        (
            {},
            {"turn": (FLOAT, {"joint": "robot/turn", "drive": "motor"})},
            "/inputs/0/mujoco/joint: the model has an actuator 'robot/turn': name that with",
        ),
    ],
)
def test_what_a_spawned_entity_does_not_have_is_said_when_it_is_spawned(
    tmp_path: Path, outputs, inputs, problem: str
) -> None:
    node, sim = simulation(tmp_path, outputs, inputs, spawned=())
    bodies = sim.model.nbody
    with pytest.raises(ModelError) as caught:
        sim.spawn_entity("robot.xml", (0, 0, 0), "robot")
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"{node.description.file}: {problem}")
    assert sim.model.nbody == bodies  # it is not there


@pytest.mark.parametrize(
    "act",
    [
        lambda sim: sim.step_to_next(),
        lambda sim: sim.step_synchronous(),
        lambda sim: sim.run_asynchronous(),
        lambda sim: sim.read("imu"),
        lambda sim: sim.command("turn", Float64()),
    ],
    ids=["step_to_next", "step_synchronous", "run_asynchronous", "read", "command"],
)
def test_what_is_never_spawned_is_said_before_the_first_step_all_at_once(
    tmp_path: Path, act
) -> None:
    outputs = {"imu": imu("robot/imu"), "there": imu("box_imu")}
    node, sim = simulation(tmp_path, outputs, turning("robot/turn"), spawned=("other",))
    with pytest.raises(ModelError) as caught:
        act(sim)
    sensor, actuator = str(caught.value).splitlines()
    assert sensor == (
        f"{node.description.file}: /outputs/0/mujoco/element: the model has no site or body "
        "'robot/imu' (did you mean 'other/imu'?); an entity that has it must be spawned before the "
        "first step"
    )
    assert "/inputs/0/mujoco/actuator: the model has no actuator 'robot/turn'" in actuator
    assert sim.sim_time == 0


def test_a_name_that_no_entity_can_have_is_said_at_once(tmp_path: Path) -> None:
    """Elements of entities are called ``name/...``."""
    with pytest.raises(ModelError, match=r"no site or body 'imu' .*'box_imu'"):
        simulation(tmp_path, {"imu": imu("imu")})


ROBOT_OF_TODAY = """
import os

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo


@neuros_initialise()
def initialise(node):
    simulator = MuJoCo(node, os.environ["NEUROS_WORLD"])
    simulator.spawn_entity(os.environ["NEUROS_ROBOT"], (0, 0, 0), "robot")
    simulator.actuate("robot/pose_theta", float(os.environ["NEUROS_ROTATION_SPEED"]))
    node.set_user_data(simulator)


@neuros_function(outputs=["ground_truth", "imu"])
def step(node):
    simulator = node.get_user_data()
    simulator.step_to_next()
    return simulator.read("ground_truth"), simulator.read("imu")
"""


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_published_experiment_declares_the_sensors_of_the_robot_that_it_spawns(
    backend: str, tmp_path: Path
) -> None:
    project = tmp_path / "whiskeye"
    shutil.copytree(PUBLISHED, project)
    robot = project / "nodes" / "robot"
    (robot / "plugin.py").write_text(ROBOT_OF_TODAY, "utf-8")
    description = json.loads((robot / "node.json").read_text("utf-8"))
    for output, kind, element in (
        ("ground_truth", "pose", "robot/body"),
        ("imu", "imu", "robot/body/imu_body"),
    ):
        (port,) = (port for port in description["outputs"] if port["name"] == output)
        port["mujoco"] = {"sensor": kind, "element": element, "rate": 50}
    (robot / "node.json").write_text(json.dumps(description), "utf-8")
    run = launch(project, "--backend", backend, "--duration", "2.1sim", cwd=tmp_path)
    assert run.exit_code == 0, run.output
    assert run.said("visualiser")[:2] == ["1 s: turned 1.0, close", "2 s: turned 2.0, close"]


def test_what_is_removed_is_gone_and_all_else_stays_as_it_is(tmp_path: Path) -> None:
    outputs = {"imu": imu("two/imu")}
    drive = {"joints": ["two/shoulder"], "drive": "velocity", "kv": 100.0}
    _, sim = simulation(tmp_path, outputs, {"go": (FLOATS, drive)}, spawned=("one", "two"))
    _, other = simulation(tmp_path, outputs, {"go": (FLOATS, drive)}, spawned=("one", "two"))
    for each in (sim, other):
        each.command("go", Float64MultiArray(data=[3.0]))
        each.actuate("two/turn", 1.0)
        each.data.body("two/body").xfrc_applied[5] = 0.5
        each.step_synchronous(10)
    sim.remove_entity("one")
    assert not [name for name in ("one/body", "one/arm") if name in sim_bodies(sim)]
    assert sim.model.nu == other.model.nu - 1
    for name in ("box_free", "turn", "two/turn", "two/shoulder"):
        kept, before = sim.data.joint(name), other.data.joint(name)
        for field in ("qpos", "qvel", "qacc_warmstart"):
            assert (getattr(kept, field) == getattr(before, field)).all(), (name, field)
    assert sim.data.body("two/body").xfrc_applied[5] == 0.5
    assert sim.data.actuator("two/turn").ctrl == 1.0
    for each in (sim, other):
        each.step_synchronous(10)
    packet, same = sim.read("imu"), other.read("imu")
    assert stamp_ns(packet) == stamp_ns(same) == 20_000_000
    # The solver's tolerance depends on all masses, so the last digits differ.
    assert packet.angular_velocity.z == pytest.approx(same.angular_velocity.z, rel=1e-3)
    assert packet.angular_velocity.z > 0.1


def sim_bodies(sim: MuJoCo) -> list[str]:
    return [sim.model.body(index).name for index in range(sim.model.nbody)]


def test_things_come_and_go_under_one_name(tmp_path: Path) -> None:
    _, sim = simulation(tmp_path, spawned=())
    bodies = sim_bodies(sim)
    for _ in range(3):
        sim.spawn_entity("cup.xml", (0, 0, 0), "cup")
        sim.step_synchronous(5)
        sim.remove_entity("cup")
        assert sim_bodies(sim) == bodies
        sim.step_synchronous(5)
    assert sim.sim_time == pytest.approx(0.03)


def test_declared_elements_of_what_is_removed_wait_for_another(tmp_path: Path) -> None:
    node, sim = simulation(tmp_path, {"imu": imu("robot/imu")})
    sim.step_to_next()
    sim.remove_entity("robot")
    with pytest.raises(ModelError, match="no site or body 'robot/imu'"):
        sim.step_to_next()
    sim.spawn_entity("robot.xml", (0, 0, 0), "robot")
    assert sim.read("imu") is not None
    sim.step_to_next()
    assert stamp_ns(sim.read("imu")) == 40_000_000
    sim.run_asynchronous(None)
    with pytest.raises(ModelError, match=r"'robot' has sensors or actuators .*stop"):
        sim.remove_entity("robot")
    node.close()


def test_what_was_never_spawned_cannot_be_removed(tmp_path: Path) -> None:
    _, sim = simulation(tmp_path)
    with pytest.raises(ModelError, match=r"no spawned entity 'robt' \(did you mean 'robot'"):
        sim.remove_entity("robt")
    with pytest.raises(ModelError, match="no spawned entity 'box'"):
        sim.remove_entity("box")


def test_a_constraint_that_was_switched_off_stays_so_and_a_mocap_body_in_its_place(
    tmp_path: Path,
) -> None:
    hand = '<body name="hand" mocap="true"/></worldbody>'
    held = '<equality><connect body1="hand" body2="cup" anchor="0 0 0"/></equality></mujoco>'
    _, sim = simulation(tmp_path, spawned=())
    (tmp_path / "held.xml").write_text(
        CUP.replace("</worldbody>", hand).replace("</mujoco>", held), "utf-8"
    )
    for name in ("one", "two", "three"):
        sim.spawn_entity("held.xml", (0, 0, 0), name)
    sim.data.eq_active[1] = 0
    sim.data.mocap_pos[:, 0] = [1, 2, 3]
    sim.remove_entity("one")
    assert sim.data.eq_active.tolist() == [0, 1]
    assert sim.data.mocap_pos[:, 0].tolist() == [2, 3]
