"""A plugin steps the simulation: firing times, reading, commands, entities."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from sensor_msgs.msg import JointState
from simulated_node import WORLD, SimulatedNode, imu, stamp_ns
from std_msgs.msg import Float64, Float64MultiArray

from neuros.errors import ModelError
from neuros.ports import Simulator
from neuros.simulators.mujoco import MuJoCo

POSE = ("geometry_msgs/msg/PoseStamped", {"sensor": "pose", "element": "box", "rate": 20})
CUBE = """
<mujoco model="cube"><worldbody><body name="cube">
  <freejoint name="free"/><geom name="g" type="box" size=".05 .05 .05"/>
</body></worldbody></mujoco>
"""


def simulation(outputs=None, inputs=None, **keywords):
    node = SimulatedNode(outputs, inputs, **keywords)
    return node, MuJoCo(node, WORLD)


# ------------------------------------------------------------------------------- firing times


def test_sensors_fire_at_whole_periods_and_never_at_zero():
    _, sim = simulation({"imu": imu("box", 50), "pose": POSE})
    assert sim.read("imu") is None
    fired = []
    for _ in range(7):
        sim.step_to_next()
        fired.append(
            [name for name in ("imu", "pose") if sim.read(name)] + [round(sim.sim_time * 1000)]
        )
    assert fired == [
        ["imu", 20],
        ["imu", 40],
        ["pose", 50],
        ["imu", 60],
        ["imu", 80],
        ["imu", "pose", 100],
        ["imu", 120],
    ]


def test_twenty_seconds_at_fifty_hertz_are_a_thousand_packets_with_exact_stamps():
    _, sim = simulation({"clock": ("rosgraph_msgs/msg/Clock", {"sensor": "clock", "rate": 50})})
    stamps = []
    for _ in range(1000):
        sim.step_to_next()
        stamps.append(stamp_ns(sim.read("clock")))
    assert stamps == [k * 20_000_000 for k in range(1, 1001)]
    assert sim.sim_time == 20.0


def test_a_packet_is_read_once():
    _, sim = simulation({"imu": imu("box")})
    sim.step_synchronous(25)
    assert stamp_ns(sim.read("imu")) == 20_000_000
    assert sim.read("imu") is None


@pytest.mark.parametrize("steps", [[40], [20, 20], [19, 1, 20], [30, 20]])
def test_crossing_two_firings_unread_is_an_error_before_any_step(steps):
    _, sim = simulation({"imu": imu("box"), "pose": POSE})
    for count in steps[:-1]:
        sim.step_synchronous(count)
    before = sim.sim_time
    with pytest.raises(ModelError) as caught:
        sim.step_synchronous(steps[-1])
    assert "sensor 'imu' would fire again at 0.04 s while its packet of 0.02 s is unread" in str(
        caught.value
    )
    assert sim.sim_time == before
    if len(steps) > 1:
        sim.read("imu")
        sim.step_synchronous(steps[-1])


def test_reading_what_is_no_sensor_is_an_error():
    _, sim = simulation({"imu": imu("box")})
    with pytest.raises(ModelError, match=r"no output 'imi' has a sensor .did you mean 'imu'"):
        sim.read("imi")


def test_without_sensors_there_is_nothing_to_step_to():
    _, sim = simulation()
    with pytest.raises(ModelError, match="no output has a sensor"):
        sim.step_to_next()


@pytest.mark.parametrize("count", [0, -1, 1.0, True])
def test_steps_are_counted_from_one(count):
    with pytest.raises(ModelError, match="count is a whole number from 1"):
        simulation()[1].step_synchronous(count)


def test_a_paused_simulation_that_cannot_be_resumed_refuses_to_step():
    _, sim = simulation()
    sim.pause()
    with pytest.raises(ModelError, match="paused"):
        sim.step_synchronous()
    sim.resume()
    sim.step_synchronous()


# ---------------------------------------------------------------------------- reproducibility


def packets_of_a_run():
    outputs = {
        "imu": imu("turn_imu"),
        "joints": ("sensor_msgs/msg/JointState", {"sensor": "joint_states", "rate": 50}),
        "image": (
            "sensor_msgs/msg/Image",
            {"sensor": "camera", "element": "eye", "rate": 10, "width": 32, "height": 24},
        ),
        "force": ("std_msgs/msg/Float64", {"sensor": "contacts", "element": "box", "rate": 50}),
    }
    node, sim = simulation(outputs, {"go": ("std_msgs/msg/Float64", {"actuator": "turn_speed"})})
    packets = []
    for step in range(50):
        sim.command("go", Float64(data=np.sin(step / 5)))
        sim.step_to_next()
        packets += [str(packet) for name in outputs if (packet := sim.read(name))]
    node.close()
    return packets


@pytest.mark.needs("OpenGL")
def test_the_same_commands_give_the_same_packets_bit_for_bit():
    first = packets_of_a_run()
    assert len(first) == 3 * 50 + 10
    assert packets_of_a_run() == first


def test_steps_one_by_one_or_many_at_once_are_the_same():
    _, one = simulation()
    _, many = simulation()
    for _ in range(300):
        one.step_synchronous()
    many.step_synchronous(300)
    assert one.data.qpos.tobytes() == many.data.qpos.tobytes()


# ------------------------------------------------------------------------------------ commands

ACTUATORS = ["turn_speed", "lift_angle", "lift_torque"]


@pytest.mark.parametrize(
    ("type_", "names", "packet", "controls"),
    [
        ("std_msgs/msg/Float64", ["lift_angle"], Float64(data=0.5), [0, 0.5, 0]),
        (
            "std_msgs/msg/Float64MultiArray",
            ["lift_torque", "turn_speed"],
            Float64MultiArray(data=[1.0, 2.0]),
            [2, 0, 1],
        ),
        (
            "sensor_msgs/msg/JointState",
            ["turn_speed", "lift_angle"],
            JointState(name=["lift", "turn"], position=[0.1, 9.0], velocity=[9.0, 0.2]),
            [0.2, 0.1, 0],
        ),
        (
            "sensor_msgs/msg/JointState",
            ACTUATORS,
            JointState(name=["lift_torque"], effort=[0.7]),
            [0, 0, 0.7],
        ),
    ],
)
def test_commands_reach_their_actuators(type_, names, packet, controls):
    _, sim = simulation(inputs={"go": (type_, {"actuators": names})})
    sim.command("go", packet)
    assert sim.data.ctrl.tolist() == controls


def test_a_twist_drives_forward_and_turning_speed():
    _, sim = simulation(
        inputs={"go": ("geometry_msgs/msg/Twist", {"actuators": ["lift_torque", "turn_speed"]})}
    )
    twist = Twist()
    twist.linear.x, twist.angular.z = 0.4, -1.0
    sim.command("go", twist)
    assert sim.data.ctrl.tolist() == [-1.0, 0, 0.4]


@pytest.mark.parametrize(
    ("type_", "packet", "says"),
    [
        (
            "std_msgs/msg/Float64MultiArray",
            Float64MultiArray(data=[1.0]),
            "1 values for 3 actuators",
        ),
        (
            "sensor_msgs/msg/JointState",
            JointState(name=["lft"]),
            "moves 'lft' (did you mean 'lift'",
        ),
        (
            "sensor_msgs/msg/JointState",
            JointState(name=["turn"], position=[1.0]),
            "command for 'turn' has no velocity",
        ),
        (
            "std_msgs/msg/Float64MultiArray",
            Float64MultiArray(data=[1.0, float("nan"), 0.0]),
            "must be a finite number, not nan",
        ),
    ],
)
def test_commands_that_do_not_fit_change_nothing(type_, packet, says):
    _, sim = simulation(inputs={"go": (type_, {"actuators": ACTUATORS})})
    with pytest.raises(ModelError, match=re.escape(says)):
        sim.command("go", packet)
    assert not sim.data.ctrl.any()


def test_unknown_names_are_refused_with_a_hint():
    _, sim = simulation(inputs={"go": ("std_msgs/msg/Float64", {"actuator": "turn_speed"})})
    with pytest.raises(ModelError, match=r"no input 'goo' has an actuator .did you mean 'go'"):
        sim.command("goo", Float64())
    with pytest.raises(ModelError, match=r"no actuator 'turnspeed' .did you mean 'turn_speed'"):
        sim.actuate("turnspeed", 1.0)
    with pytest.raises(ModelError, match="finite"):
        sim.actuate("turn_speed", float("inf"))


# ------------------------------------------------------------------------- entities and reset


def test_a_spawned_entity_leaves_the_state_of_everything_else(tmp_path):
    (tmp_path / "cube.xml").write_text(CUBE)
    _, sim = simulation({"imu": imu("turn_imu"), "pose": POSE}, folder=tmp_path)
    sim.actuate("turn_speed", 1.0)
    sim.actuate("lift_angle", 0.4)
    sim.step_to_next()
    sim.read("imu")
    sim.step_synchronous(15)
    sim.data.xfrc_applied[1] = 0.1
    kept = ("qpos", "qvel", "ctrl", "qacc_warmstart", "xfrc_applied")
    before = {field: getattr(sim.data, field).copy() for field in kept}
    sim.spawn_entity("cube.xml", (4.0, 0.0, 3.0), "toy")
    for field, old in before.items():
        assert getattr(sim.data, field)[: len(old)].tobytes() == old.tobytes()
    assert sim.data.body("toy/cube").xpos == pytest.approx([4, 0, 3])
    assert sim.data.time == pytest.approx(0.035)
    assert sim.sim_time == 0.035
    sim.step_to_next()
    assert stamp_ns(sim.read("imu")) == 40_000_000
    assert sim.data.body("toy/cube").xpos[2] < 3


def test_entities_spawn_more_than_once_under_names_of_their_own(tmp_path):
    (tmp_path / "cube.xml").write_text(CUBE)
    _, sim = simulation(folder=tmp_path)
    for number in range(3):
        sim.spawn_entity(tmp_path / "cube.xml", (4.0, number, 1.0), f"toy{number}")
    assert sim.data.body("toy2/cube").xpos == pytest.approx([4, 2, 1])
    with pytest.raises(ModelError, match="'toy1' is taken"):
        sim.spawn_entity("cube.xml", (0, 0, 0), "toy1")


def test_an_entity_that_does_not_compile_is_named_and_changes_nothing(tmp_path):
    (tmp_path / "bad.xml").write_text(CUBE.replace('size=".05 .05 .05"', 'size="0 0 0"'))
    (tmp_path / "cube.xml").write_text(CUBE)
    _, sim = simulation(folder=tmp_path)
    sim.step_synchronous(10)
    with pytest.raises(ModelError, match=r"bad\.xml: the model does not compile"):
        sim.spawn_entity("bad.xml", (0, 0, 1), "toy")
    sim.spawn_entity("cube.xml", (0, 0, 1), "toy")
    sim.step_synchronous(10)


def test_reset_goes_back_to_time_zero_and_forgets_unread_packets():
    _, sim = simulation({"imu": imu("box")})
    start = sim.data.qpos.copy()
    sim.actuate("turn_speed", 1.0)
    sim.step_to_next()
    sim.reset()
    assert sim.sim_time == 0
    assert sim.read("imu") is None
    assert sim.data.qpos.tobytes() == start.tobytes()
    assert not sim.data.ctrl.any()
    sim.step_to_next()
    assert stamp_ns(sim.read("imu")) == 20_000_000


# ------------------------------------------------------------------------------------ the rest


def test_the_node_can_tell_simulated_time():
    node, sim = simulation()
    sim.step_synchronous(250)
    assert node.read_time_s() == sim.sim_time == 0.25
    assert sim.timestep == 0.001


def test_an_exploding_simulation_is_an_error_and_not_a_silent_restart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning in the current folder
    _, sim = simulation()
    sim.data.qvel[:] = 1e300
    with pytest.raises(ModelError, match=r"unstable between 0 s and 0.01 s of simulated time"):
        sim.step_synchronous(10)


def test_a_viewer_without_a_display_is_one_warning(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    node, sim = simulation(environment={"NEUROS_GUI": "1"})
    sim.step_synchronous(10)
    assert node.log.warnings == ["NEUROS_GUI is set, but no viewer opens: there is no display"]


def test_importing_the_room_does_not_import_mujoco():
    code = "import sys, neuros.simulators; assert not {'mujoco', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30)


def test_meshes_of_an_entity_are_found_beside_its_own_file(tmp_path):
    folder = tmp_path / "toys"
    folder.mkdir()
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    (folder / "tetra.obj").write_text(corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    (folder / "tetra.xml").write_text(
        """<mujoco model="tetra"><asset><mesh name="m" file="tetra.obj" scale=".1 .1 .1"/></asset>
        <worldbody><body name="t"><freejoint/><geom type="mesh" mesh="m"/></body></worldbody>
        </mujoco>"""
    )
    _, sim = simulation(folder=tmp_path)
    sim.spawn_entity("toys/tetra.xml", (0, -2, 1), "toy")
    sim.spawn_entity("toys/tetra.xml", (1, -2, 1), "other")
    assert sim.model.nmesh == 2
    sim.step_synchronous(10)


def test_it_offers_all_that_a_simulator_has_to() -> None:
    promised = {name for name in vars(Simulator) if not name.startswith("_")}
    assert promised
    assert promised <= set(dir(MuJoCo))
