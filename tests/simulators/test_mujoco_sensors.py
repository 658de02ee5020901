"""Readings of the sensors, checked against physics and against MuJoCo's own sensors."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from simulated_node import WORLD, SimulatedNode, imu, stamp_ns

from neuros.simulators.mujoco import MuJoCo

G = 9.81


def run(outputs, seconds, model=WORLD, **actuators):
    """The last packet of each output after ``seconds``, and the simulator."""
    sim = MuJoCo(SimulatedNode(outputs), model)
    for name, value in actuators.items():
        sim.actuate(name, value)
    packets = {}
    while sim.sim_time < seconds:
        sim.step_to_next()
        packets.update({name: new for name in outputs if (new := sim.read(name))})
    return packets, sim


def vector(v):
    return np.array([v.x, v.y, v.z])


def quaternion(q):
    return np.array([q.w, q.x, q.y, q.z])


def test_in_free_fall_an_imu_feels_nothing():
    packets, _ = run({"imu": imu("fall_imu")}, 1.0)
    assert np.abs(vector(packets["imu"].linear_acceleration)).max() < 1e-9
    assert np.abs(vector(packets["imu"].angular_velocity)).max() < 1e-9


@pytest.mark.parametrize("element", ["box_imu", "box"])
def test_at_rest_an_imu_feels_the_floor_push_up(element):
    packets, _ = run({"imu": imu(element)}, 1.0)
    assert vector(packets["imu"].linear_acceleration) == pytest.approx([0, 0, G], abs=1e-3)
    assert vector(packets["imu"].angular_velocity) == pytest.approx([0, 0, 0], abs=1e-6)
    assert quaternion(packets["imu"].orientation) == pytest.approx([1, 0, 0, 0], abs=1e-3)
    assert packets["imu"].header.frame_id == element
    assert stamp_ns(packets["imu"]) == 1_000_000_000


def test_on_a_turntable_a_gyroscope_measures_the_rate_and_the_accelerometer_the_centripetal_force():
    packets, sim = run({"axis": imu("axis_imu"), "rim": imu("turn_imu")}, 2.0, turn_speed=1.5)
    rate = sim.data.qvel[sim.model.joint("turn").dofadr[0]]
    assert rate == pytest.approx(1.5, abs=1e-3)
    assert vector(packets["axis"].angular_velocity) == pytest.approx([0, 0, rate], abs=1e-12)
    # The site on the rim is turned by 90 degrees about x: its y axis points up, its z axis to -y.
    assert vector(packets["rim"].angular_velocity) == pytest.approx([0, rate, 0], abs=1e-12)
    felt = vector(packets["rim"].linear_acceleration)
    assert felt == pytest.approx([-(rate**2) * 0.5, G, 0], abs=1e-2)


@pytest.mark.parametrize("element", ["hub", "hub_site"])
def test_in_a_model_without_any_sensor_a_gyroscope_is_not_silent(element):
    """MuJoCo leaves out what no sensor of the model asks for; the declared one is not in it."""
    model = """<mujoco><option timestep="0.002"/><worldbody><body name="hub">
               <joint name="spin" axis="0 0 1"/><geom size=".1"/><site name="hub_site"/>
               </body></worldbody></mujoco>"""
    sim = MuJoCo(SimulatedNode({"imu": imu(element)}), model)
    assert sim.model.nsensor == 0
    with sim.paused():
        sim.data.joint("spin").qvel[0] = 1.25
    for _ in range(3):
        sim.step_to_next()
        packet = sim.read("imu")
        assert vector(packet.angular_velocity) == pytest.approx([0, 0, 1.25])
        assert vector(packet.linear_acceleration) == pytest.approx([0, 0, G])


def test_values_are_those_of_mujocos_own_sensors_bit_for_bit():
    spec = mujoco.MjSpec.from_string(WORLD)
    reference = mujoco.MjSpec.from_string(WORLD)
    kinds = (mujoco.mjtSensor.mjSENS_GYRO, mujoco.mjtSensor.mjSENS_ACCELEROMETER)
    for kind in (*kinds, mujoco.mjtSensor.mjSENS_FRAMEQUAT, mujoco.mjtSensor.mjSENS_FRAMEPOS):
        reference.add_sensor(
            name=str(kind), type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="turn_imu"
        )
    model = reference.compile()
    data = mujoco.MjData(model)
    outputs = {
        "imu": imu("turn_imu", 100),
        "pose": (
            "geometry_msgs/msg/Pose",
            {"sensor": "pose", "element": "turn_imu", "rate": 100},
        ),
    }
    sim = MuJoCo(SimulatedNode(outputs), spec)
    sim.actuate("turn_speed", 3.0)
    sim.actuate("lift_angle", 0.5)
    data.ctrl[:2] = 3.0, 0.5
    for _ in range(50):
        sim.step_to_next()
        mujoco.mj_step(model, data, nstep=10)
        mujoco.mj_forward(model, data)
        packet, pose = sim.read("imu"), sim.read("pose")
        measured = np.concatenate(
            [
                vector(packet.angular_velocity),
                vector(packet.linear_acceleration),
                quaternion(packet.orientation),
                vector(pose.position),
            ]
        )
        assert measured.tobytes() == data.sensordata.tobytes()


def test_the_models_own_sensor_gives_its_cutoff_and_its_noise_as_covariance():
    own = """<sensor><gyro site="axis_imu" cutoff="0.5" noise="0.02"/>
             <accelerometer site="axis_imu" noise="0.3"/></sensor></mujoco>"""
    model = WORLD.replace("</mujoco>", own)
    packets, _ = run({"imu": imu("axis_imu")}, 1.0, model, turn_speed=2.0)
    packet = packets["imu"]
    assert vector(packet.angular_velocity)[2] == 0.5
    assert packet.angular_velocity_covariance == pytest.approx(np.diag([4e-4] * 3).ravel())
    assert packet.linear_acceleration_covariance == pytest.approx(np.diag([0.09] * 3).ravel())
    assert not packet.orientation_covariance.any()  # nothing declared: unknown


def test_a_reading_belongs_to_the_time_of_its_stamp():
    """Right after mj_step MuJoCo's readings are one step old; a falling body shows it."""
    body = "<body name='b'><freejoint/><geom size='1'/></body>"
    model = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    pose = ("geometry_msgs/msg/PoseStamped", {"sensor": "pose", "element": "b", "rate": 500})
    packets, sim = run({"pose": pose}, 0.1, model)
    assert packets["pose"].pose.position.z == sim.data.qpos[2]


def test_sensors_do_not_disturb_the_physics():
    _, watched = run({"imu": imu("box_imu", 1000), "rim": imu("turn_imu", 250)}, 0.5)
    blind = MuJoCo(SimulatedNode(), WORLD)
    blind.step_synchronous(500)
    assert watched.data.qpos.tobytes() == blind.data.qpos.tobytes()
    assert watched.data.qvel.tobytes() == blind.data.qvel.tobytes()


def test_poses_are_in_the_world():
    outputs = {
        "a": ("geometry_msgs/msg/PoseStamped", {"sensor": "pose", "element": "arm", "rate": 50}),
        "b": ("geometry_msgs/msg/Pose", {"sensor": "pose", "element": "turntable", "rate": 50}),
    }
    packets, sim = run(outputs, 0.5, turn_speed=1.0)
    assert vector(packets["a"].pose.position) == pytest.approx(sim.data.body("arm").xpos)
    assert quaternion(packets["a"].pose.orientation) == pytest.approx(sim.data.body("arm").xquat)
    assert packets["a"].header.frame_id == "world"
    assert vector(packets["b"].position) == pytest.approx([0, 2, 1])


def test_joint_states_of_all_or_of_named_joints():
    joint_state = "sensor_msgs/msg/JointState"
    outputs = {
        "all": (joint_state, {"sensor": "joint_states", "rate": 50}),
        "some": (joint_state, {"sensor": "joint_states", "element": ["lift"], "rate": 50}),
    }
    packets, sim = run(outputs, 0.5, turn_speed=1.0, lift_angle=0.3)
    whole, some = packets["all"], packets["some"]
    assert whole.name == ["turn", "lift"]
    assert some.name == ["lift"]
    joint = sim.data.joint("lift")
    assert (some.position[0], some.velocity[0]) == (joint.qpos[0], joint.qvel[0])
    assert some.effort[0] == whole.effort[1] == joint.qfrc_actuator[0] != 0


def test_contacts_of_a_box_on_the_floor():
    def contacts(type_, element):
        return type_, {"sensor": "contacts", "element": element, "rate": 50}

    outputs = {
        "touch": contacts("std_msgs/msg/Bool", "box"),
        "no_touch": contacts("std_msgs/msg/Bool", "falling"),
        "force": contacts("std_msgs/msg/Float64", "box_geom"),
        "forces": contacts("std_msgs/msg/Float64MultiArray", ["box", "arm", "floor"]),
        "wrench": contacts("geometry_msgs/msg/WrenchStamped", "box"),
        "floor": contacts("geometry_msgs/msg/WrenchStamped", "floor"),
    }
    packets, _ = run(outputs, 1.0)
    weight = 2 * G
    assert packets["touch"].data is True
    assert packets["no_touch"].data is False
    assert packets["force"].data == pytest.approx(weight, rel=1e-3)
    assert list(packets["forces"].data) == pytest.approx([weight, 0, weight], rel=1e-3)
    assert vector(packets["wrench"].wrench.force) == pytest.approx([0, 0, weight], abs=1e-2)
    assert vector(packets["wrench"].wrench.torque) == pytest.approx([0, 0, 0], abs=1e-2)
    assert vector(packets["floor"].wrench.force) == pytest.approx([0, 0, -weight], abs=1e-2)
    # The box stands at x = 2: its weight tilts the floor about y.
    assert vector(packets["floor"].wrench.torque) == pytest.approx([0, 2 * weight, 0], abs=1e-2)


@pytest.mark.needs("OpenGL")
def test_a_camera_sees_the_red_floor_below_the_horizon():
    camera = {"sensor": "camera", "element": "eye", "rate": 10, "width": 64, "height": 48}
    node = SimulatedNode({"image": ("sensor_msgs/msg/Image", camera)})
    sim = MuJoCo(node, WORLD)
    sim.step_to_next()
    image = sim.read("image")
    node.close()
    pixels = np.array(image.data, dtype=np.uint8).reshape(48, 64, 3)
    assert (image.width, image.height, image.step, image.encoding) == (64, 48, 192, "rgb8")
    assert stamp_ns(image) == 100_000_000
    bottom = pixels[-1].mean(axis=0)
    assert bottom[0] > 20
    assert bottom[0] > 2 * bottom[1]
    assert pixels[0].sum() == 0  # above the horizon: nothing


def test_a_clock_tells_simulated_time():
    clock = ("rosgraph_msgs/msg/Clock", {"sensor": "clock", "rate": 4})
    packets, _ = run({"clock": clock}, 2.5)
    assert (packets["clock"].clock.sec, packets["clock"].clock.nanosec) == (2, 500_000_000)
