"""Every program and project of the page on other ROS 2 nodes runs, beside plain rclpy programs."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from launching import REPOSITORY, Finished, start
from needs import COMPILER
from plain_programs import plain_program
from ros_program import RosProgram

from neuros.backends.domain import choose_domain
from neuros.transport.messages import message_class

PAGE = (REPOSITORY / "docs/external_nodes.md").read_text("utf-8")
LIMIT_S = 120.0

ROVER = """
from neuros.hooks import neuros_function

@neuros_function(inputs="scan", outputs="map")
def draw(node, scan):
    node.shutdown(f"ranges {list(scan.ranges)}, up to {scan.range_max:g} m")
    return node.make_packet("map")
"""
PARAMETERS = """
from neuros.hooks import neuros_initialise

@neuros_initialise()
def start(node):
    ros = node.get_ros_node()
    values = [ros.get_parameter(name).value for name in ("max_speed", "gain.p", "frames")]
    node.shutdown(f"{values}")
"""
PHYSICS = """
from neuros.hooks import neuros_initialise
from neuros.simulators.mujoco import MuJoCo

@neuros_initialise()
def start(node):
    sim = MuJoCo(node, "<mujoco><option timestep='0.01'/></mujoco>")
    sim.run_asynchronous(None)
"""
PLANNER = """
from neuros.hooks import neuros_initialise

@neuros_initialise()
def start(node):
    ros = node.get_ros_node()
    ros.create_timer(2.0, lambda: node.shutdown("2 s of simulated time"))
"""
BRAIN = """
from neuros.hooks import neuros_function

@neuros_function(inputs="imu", outputs="command")
def steer(node, imu):
    command = node.make_packet("command")
    command.angular.z = -imu.angular_velocity.z
    return command
"""


def blocks(language: str, heading: str) -> list[str]:
    section = re.split(rf"^##+ {heading}$", PAGE, flags=re.MULTILINE)[1]
    section = re.split(r"^##", section, flags=re.MULTILINE)[0]
    return re.findall(rf"```{language}\n(.*?)```", section, re.DOTALL)


def run(
    folder: Path,
    heading: str,
    plugins: dict[str, str],
    beside: Callable[[RosProgram], object] = lambda _: None,
) -> Finished:
    """Run the project, or the node, under a heading; ``beside`` goes on until it ends."""
    content = json.loads(blocks("json", heading)[0])
    project = content if "nodes" in content else {"nodes": [content]}
    (folder / "project.json").write_text(json.dumps(project))
    for name, text in plugins.items():
        (folder / name).write_text(text)
    with (
        choose_domain(None, {}, False) as domain,
        RosProgram(domain_id=domain.id) as program,
        start(folder, "-d", str(domain.id), "--backend", "process", cwd=folder) as running,
    ):
        beside(program)
        finished = running.finish(LIMIT_S)
    assert finished.exit_code == 0, finished.output
    return finished


def publish_until(
    program: RosProgram, type_name: str, topic: str, message: Any, is_over: Callable[[], bool]
) -> None:
    publisher = program.node.create_publisher(message_class(type_name), topic, 10)

    def tell() -> bool:
        publisher.publish(message)
        program.spin(0.05)
        return is_over()

    program.spin_until(tell, LIMIT_S)


def test_the_program_is_heard_by_the_rover(tmp_path: Path) -> None:
    (program,) = blocks("python", "A program beside a project")
    (tmp_path / "lidar.py").write_text(program)
    content = json.loads(blocks("json", "Topics")[0])
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [content]}))
    (tmp_path / "rover.py").write_text(ROVER)
    with (
        choose_domain(None, {}, False) as domain,
        plain_program(tmp_path / "lidar.py", domain.id),
        start(tmp_path, "-d", str(domain.id), "--backend", "process", cwd=tmp_path) as running,
    ):
        finished = running.finish(LIMIT_S)
    assert finished.exit_code == 0, finished.output
    assert finished.record["reason"] == "rover ended the project: ranges [1.0, 2.0], up to 10 m"


@pytest.mark.needs(*COMPILER)
def test_transforms_are_received_chained_and_sent(tmp_path: Path) -> None:
    (plugin,) = blocks("python", "Transforms")
    around = """
hands = answers = 0

@neuros_tick(seconds=0.05, outputs="pose")
def show_hand(node):
    packet = node.make_packet("pose")
    packet.transforms = [transform("world", "hand", 0, (1.0, 0.0, 2.0))]
    return packet

@neuros_function(inputs="tf")
def count(node, packet):
    global hands, answers
    (found,) = packet.transforms
    hands += found.child_frame_id == "hand"
    answers += found.child_frame_id == "base"
    if hands > 9 and answers:
        node.shutdown(f"{found.transform.translation.z:.1f}, {answers <= hands}")
"""
    plugin = plugin.replace("import Optional", "import Optional, neuros_tick")
    finished = run(tmp_path, "Transforms", {"robot.py": plugin + around})
    assert re.fullmatch(r"robot ended the project: 2\.[01], True", finished.record["reason"])


def test_parameters_are_those_of_the_ros_node(tmp_path: Path) -> None:
    finished = run(tmp_path, "Parameters", {"rover.py": PARAMETERS})
    assert finished.record["reason"] == "rover ended the project: [0.5, 1.5, ('base', 'head')]"


def test_the_clock_of_the_physics_is_that_of_other_ros_nodes(tmp_path: Path) -> None:
    plugins = {"physics.py": PHYSICS, "planner.py": PLANNER}
    finished = run(tmp_path, "Simulated time", plugins)
    assert finished.record["reason"] == "planner ended the project: 2 s of simulated time"


def test_the_robot_is_commanded_on_its_own_topics(tmp_path: Path) -> None:
    imu = message_class("sensor_msgs/msg/Imu")()
    imu.angular_velocity.z = 0.5
    plugin = BRAIN.replace("    return", "    node.shutdown('commanded')\n    return")
    heard: list[Any] = []

    def robot(program: RosProgram) -> None:
        heard.append(program.listen("/cmd_vel", "geometry_msgs/msg/Twist"))
        publish_until(program, "sensor_msgs/msg/Imu", "/imu/data", imu, lambda: bool(heard[0]))

    run(tmp_path, "From the simulator to the robot", {"brain.py": plugin}, robot)
    assert heard[0][0].angular.z == -0.5
