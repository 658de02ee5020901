"""Problems of declarations are reported before the first step, by file and key."""

from __future__ import annotations

import mujoco
import pytest
from jsonschema import Draft202012Validator
from simulated_node import WORLD, SimulatedNode, imu

from neuros.errors import ModelError
from neuros.project.model import Node, Port
from neuros.project.validate import schema
from neuros.simulators.mujoco import MuJoCo
from neuros.simulators.mujoco.lookup import Problems
from neuros.simulators.mujoco.sensors import SENSORS, read_sensors, with_sensors

IMU, CLOCK = "sensor_msgs/msg/Imu", "rosgraph_msgs/msg/Clock"
STRING, FLOAT = "std_msgs/msg/String", "std_msgs/msg/Float64"
FLOATS = "std_msgs/msg/Float64MultiArray"


def problems_of(outputs=None, inputs=None, model=WORLD):
    with pytest.raises(ModelError) as caught:
        MuJoCo(SimulatedNode(outputs, inputs), model)
    return str(caught.value).splitlines()


def test_a_wrong_element_is_named_with_the_nearest_right_one():
    (problem,) = problems_of({"imu": imu("box_imuu")})
    assert problem == (
        "/nowhere/robot.json: /outputs/0/mujoco/element: "
        "the model has no site or body 'box_imuu' (did you mean 'box_imu'?)"
    )


def test_a_name_that_resembles_nothing_lists_what_there_is():
    (problem,) = problems_of(inputs={"go": (FLOAT, {"actuator": "zzz"})})
    assert problem.endswith(
        "/inputs/0/mujoco/actuator: the model has no actuator 'zzz' "
        "(there are: lift_angle, lift_torque, turn_speed)"
    )


def test_a_period_of_broken_steps_is_refused():
    (problem,) = problems_of({"clock": (CLOCK, {"sensor": "clock", "rate": 300})})
    assert problem.startswith("/nowhere/robot.json: /outputs/0/mujoco/rate: 300 Hz is a period of")
    assert "333.3333333 Hz (every 3 steps) and 250 Hz (every 4 steps)" in problem


@pytest.mark.parametrize(
    ("type_", "keys", "pointer", "says"),
    [
        (STRING, {"sensor": "imu", "element": "box", "rate": 50}, "sensor", "fills sensor_msgs"),
        (IMU, {"sensor": "imuu", "element": "box", "rate": 50}, "sensor", "did you mean 'imu'"),
        (IMU, {"element": "box", "rate": 50}, "sensor", "None is not a kind of sensor"),
        (IMU, {"sensor": "imu", "rate": 50}, "element", "missing"),
        (IMU, {"sensor": "imu", "element": ["box"], "rate": 50}, "element", "one element only"),
        (IMU, {"sensor": "imu", "element": "box"}, "rate", "not a positive number"),
        (IMU, {"sensor": "imu", "element": "box", "rate": 0}, "rate", "0 is not a positive"),
        (IMU, {"sensor": "imu", "element": "box", "rate": True}, "rate", "True is not"),
        (IMU, {"sensor": "imu", "element": "box", "rat": 1, "rate": 1}, "rat", "mean 'rate'"),
        (IMU, {"sensor": "imu", "element": "box", "rate": 1, "width": 9}, "width", "unknown key"),
        (CLOCK, {"sensor": "clock", "element": "box", "rate": 1}, "element", "leave this key out"),
        (
            "sensor_msgs/msg/JointState",
            {"sensor": "joint_states", "element": ["turn", "box_free"], "rate": 50},
            "element",
            "joint 'box_free' is neither a hinge nor a slide",
        ),
        (
            "sensor_msgs/msg/Image",
            {"sensor": "camera", "element": "eye", "rate": 10, "width": 0},
            "width",
            "0 is not a number of pixels",
        ),
        (
            "std_msgs/msg/Bool",
            {"sensor": "contacts", "element": ["box", "arm"], "rate": 10},
            "element",
            "a list needs std_msgs/msg/Float64MultiArray",
        ),
    ],
)
def test_faulty_sensors(type_, keys, pointer, says):
    (problem,) = problems_of({"out": (type_, keys)})
    assert problem.startswith(f"/nowhere/robot.json: /outputs/0/mujoco/{pointer}: ")
    assert says in problem


@pytest.mark.parametrize(
    ("type_", "keys", "says"),
    [
        (FLOAT, {}, None),
        (FLOAT, {"actuator": 3}, "/actuator: 3 is not a name"),
        (FLOAT, {"actuator": "turn_speed", "actuators": ["turn_speed"]}, "give either 'actuator'"),
        (FLOATS, {"actuators": "turn_speed"}, "/actuators: 'turn_speed' is not a list of names"),
        (FLOAT, {"actuators": ["turn_speed", "lift_angle"]}, "drives 1 actuators, not 2"),
        (STRING, {"actuator": "turn_speed"}, "a command is std_msgs/msg/Float64 or"),
        ("geometry_msgs/msg/Twist", {"actuator": "turn_speed"}, "drives 2 or 3 or 6 actuators"),
        (FLOAT, {"actuator": "turn_speed", "gain": 2}, "/gain: unknown key"),
    ],
)
def test_faulty_actuators(type_, keys, says):
    if says is None:  # an input without a declaration is none of the simulator's business
        MuJoCo(SimulatedNode(inputs={"go": (type_, keys)}), WORLD)
        return
    (problem,) = problems_of(inputs={"go": (type_, keys)})
    assert problem.startswith("/nowhere/robot.json: /inputs/0/mujoco")
    assert says in problem


def declarations():
    """Every kind of sensor with every message type, with no element, one, and a list."""
    for kind, sensor in SENSORS.items():
        for type_ in sensor.types:
            for element in ({}, {"element": "box"}, {"element": ["box", "arm"]}):
                yield type_, {"sensor": kind, "rate": 50, **element}
                yield type_, {"sensor": kind, "rate": 50, **element, "width": 64, "height": 48}


def is_accepted(type_, keys):
    problems = Problems("robot.json")
    port = Port("out", type_, mujoco=keys)
    node = Node("robot", "neuros_mujoco", SimulatedNode().description.plugin, outputs=(port,))
    return bool(read_sensors(node, problems))


@pytest.mark.parametrize("kind", SENSORS)
def test_the_schema_takes_what_the_simulator_takes_for_some_type(kind):
    validator = Draft202012Validator(schema("node")["$defs"]["mujoco_sensor"])
    verdicts = {}
    for type_, keys in declarations():
        if keys["sensor"] == kind:
            verdict = verdicts.setdefault(str(keys), [keys, False])
            verdict[1] |= is_accepted(type_, keys)
    for keys, is_taken in verdicts.values():
        assert validator.is_valid(keys) == is_taken, keys


def test_the_schema_has_the_sensors_of_the_simulator():
    written = "from neuros.simulators.mujoco.sensors import write_schema; write_schema()"
    assert with_sensors(schema("node")) == schema("node"), f'run: python -c "{written}"'


def test_all_problems_come_at_once():
    problems = problems_of(
        {"a": imu("nothing"), "b": imu("box", rate=30), "c": (IMU, {"sensor": "smell"})},
        {"go": (FLOAT, {"actuator": "nothing"})},
    )
    assert len(problems) == 4


def test_a_model_that_does_not_compile_is_named_by_its_file(tmp_path):
    path = tmp_path / "broken.xml"
    path.write_text("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    with pytest.raises(ModelError) as caught:
        MuJoCo(SimulatedNode(folder=tmp_path), "broken.xml")
    assert str(caught.value).startswith(f"{path}: the model does not compile: ")
    assert "mass and inertia" in str(caught.value)


def test_a_model_that_is_no_xml_is_named_by_its_file(tmp_path):
    path = tmp_path / "broken.xml"
    path.write_text("<mujoco><worldbody>")
    with pytest.raises(ModelError, match=r"broken\.xml: the model does not compile"):
        MuJoCo(SimulatedNode(folder=tmp_path), path)


def test_a_model_that_does_not_exist_is_said_with_the_places(tmp_path):
    with pytest.raises(ModelError, match=r"'no\.xml' does not exist: looked for"):
        MuJoCo(SimulatedNode(folder=tmp_path), "no.xml")


def test_a_model_comes_as_file_text_or_spec(tmp_path):
    (tmp_path / "world.xml").write_text(WORLD)
    spec = mujoco.MjSpec.from_string(WORLD)
    for model in ("world.xml", tmp_path / "world.xml", WORLD, spec):
        assert MuJoCo(SimulatedNode(folder=tmp_path), model).model.nu == 3
    with pytest.raises(ModelError, match="not a int"):
        MuJoCo(SimulatedNode(), 3)


@pytest.mark.needs("OpenGL")
def test_the_spec_of_the_plugin_is_not_touched():
    spec = mujoco.MjSpec.from_string(WORLD)
    camera = {"sensor": "camera", "element": "eye", "rate": 10, "width": 4000, "height": 10}
    MuJoCo(SimulatedNode({"image": ("sensor_msgs/msg/Image", camera)}), spec)
    assert spec.compile().vis.global_.offwidth == 640
