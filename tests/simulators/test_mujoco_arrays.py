"""Sensors and actuators on ports of arrays: the numbers of MuJoCo, and its physics bit for bit."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_node import SimulatedNode

from neuros.errors import ModelError
from neuros.simulators.mujoco import MuJoCo
from neuros.simulators.mujoco.readings import _COMPUTED, STATE

HOPPER = """
<mujoco>
  <option timestep="0.004"/>
  <size nuserdata="2"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 .1"/>
    <camera name="eye" pos="0 -3 1" xyaxes="1 0 0 0 0 1"/>
    <body name="target" mocap="true" pos="1 0 1"/>
    <body name="torso" pos="0 0 .5">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="trunk" type="capsule" size=".05" fromto="0 0 .2 0 0 0"/>
      <site name="imu"/>
      <body name="leg">
        <joint name="knee" axis="0 1 0" damping=".1"/>
        <geom name="foot" type="capsule" size=".04" fromto="0 0 0 0 0 -.4"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="knee" gear="5"/>
    <general name="lift" joint="z" gainprm="40" dyntype="filter" dynprm=".1"/>
  </actuator>
  <tendon><fixed><joint joint="knee" coef="2"/></fixed></tendon>
  <sensor><accelerometer name="felt" site="imu"/><jointpos name="bent" joint="knee"/></sensor>
</mujoco>
"""
STEPS, ROUNDS = 5, 300


def declared(kind: str, type_: str, element: Any = None, **keys: Any) -> tuple[str, dict[str, Any]]:
    element = {} if element is None else {"element": element}
    return type_, {"sensor": kind, "rate": 50, **element, **keys}


def data(type_: str, *names: str) -> tuple[str, dict[str, Any]]:
    return declared("data", type_, list(names))


CONTROL = {"control": ("float64[2]", {"actuators": "all"})}


def hopper(outputs: Any, inputs: Any = CONTROL) -> MuJoCo:
    return MuJoCo(SimulatedNode(outputs, inputs), HOPPER)


def actions(seed: int = 1) -> Any:
    return np.random.default_rng(seed).uniform(-1, 1, (ROUNDS, 2))


# ---------------------------------------------------------------------- the physics


def test_observations_are_those_of_bare_mujoco_bit_for_bit() -> None:
    sim = hopper({"observation": data("float64[6]", "qpos", "qvel")})
    model = mujoco.MjModel.from_xml_string(HOPPER)
    bare = mujoco.MjData(model)
    for action in actions():
        sim.command("control", action)
        sim.step_to_next()
        bare.ctrl[:] = action
        mujoco.mj_step(model, bare, nstep=STEPS)
        expected = np.concatenate([bare.qpos, bare.qvel])
        assert sim.read("observation").tobytes() == expected.tobytes()
    assert bare.ncon  # it has been on the floor


def test_what_mujoco_computes_is_that_of_the_state_and_changes_nothing() -> None:
    names = ("qpos", "sensordata", "xpos", "qfrc_actuator", "time", "cfrc_ext")
    sim = hopper({"seen": data("float64[47]", *names)})
    model = mujoco.MjModel.from_xml_string(HOPPER)
    bare, seen = mujoco.MjData(model), mujoco.MjData(model)
    for action in actions():
        sim.command("control", action)
        sim.step_to_next()
        bare.ctrl[:] = action
        mujoco.mj_step(model, bare, nstep=STEPS)
        mujoco.mj_copyData(seen, model, bare)
        mujoco.mj_forward(model, seen)
        mujoco.mj_rnePostConstraint(model, seen)
        expected = np.concatenate([np.ravel(getattr(seen, name)) for name in names])
        assert np.array_equal(sim.read("seen"), expected)
    assert sim.data.qpos.tobytes() == bare.qpos.tobytes()


@pytest.mark.parametrize(
    ("outputs", "calls"),
    [
        ({"a": data("float64[8]", "qpos", "qvel", "ctrl"), "b": data("float64[1]", "time")}, 0),
        ({"clock": declared("clock", "rosgraph_msgs/msg/Clock")}, 0),
        ({"a": data("float64[3]", "qpos"), "b": data("float64[4]", "sensordata")}, 3),
        ({"a": declared("joint_states", "sensor_msgs/msg/JointState")}, 3),
    ],
)
def test_mj_forward_is_called_where_a_sensor_that_is_due_needs_it(
    outputs: Any, calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sim, called, forward = hopper(outputs), [], mujoco.mj_forward
    monkeypatch.setattr(mujoco, "mj_forward", lambda *of: (called.append(1), forward(*of)))
    for _ in range(3):
        sim.step_to_next()
        for name in outputs:
            assert sim.read(name) is not None
    assert len(called) == calls


def test_after_a_reset_everything_is_as_before() -> None:
    sim = hopper({"seen": data("float64[10]", "qpos", "qvel", "sensordata")})

    def episode() -> bytes:
        seen = b""
        for action in actions()[:50]:
            sim.command("control", action)
            sim.step_to_next()
            seen += sim.read("seen").tobytes()
        return seen

    first = episode()
    sim.reset()
    assert episode() == first


# ---------------------------------------------------------------------- the numbers


def test_a_packet_is_its_own() -> None:
    sim = hopper({"state": data("float64[3]", "qpos")})
    sim.step_to_next()
    packet = sim.read("state")
    before = packet.copy()
    sim.step_synchronous(STEPS)
    assert np.array_equal(packet, before)
    packet[:] = 0
    assert sim.data.qpos.any()


@pytest.mark.parametrize("name", [*STATE, *_COMPUTED])
def test_every_array_of_mjdata_can_be_sent(name: str) -> None:
    model = mujoco.MjModel.from_xml_string(HOPPER)
    size = np.size(getattr(mujoco.MjData(model), name))
    sim = hopper({"seen": data(f"float64[{size}]", name)})
    sim.step_to_next()
    assert np.array_equal(sim.read("seen"), np.ravel(getattr(sim.data, name)))


@settings(max_examples=40, deadline=None)
@given(st.none() | st.integers(-7, 7), st.none() | st.integers(-7, 7))
def test_a_part_is_that_of_python(first: int | None, end: int | None) -> None:
    name = f"xpos[{'' if first is None else first}:{'' if end is None else end}]"
    if not (bodies := np.zeros(4)[first:end].size):
        with pytest.raises(ModelError, match=r"fill float64\[0\]"):
            hopper({"seen": data("float64[1]", name)})
        return
    sim = hopper({"seen": data(f"float64[{bodies},3]", name)})
    sim.step_to_next()
    assert np.array_equal(sim.read("seen"), sim.data.xpos[first:end])


def test_float32_is_rounded_because_the_port_says_so() -> None:
    sim = hopper({"near": data("float32[6]", "qpos", "qvel")})
    sim.step_to_next()
    near = sim.read("near")
    assert near.dtype == np.float32
    assert np.array_equal(near, np.concatenate([sim.data.qpos, sim.data.qvel]).astype(np.float32))


def test_other_sensors_fill_arrays_with_the_numbers_of_their_messages() -> None:
    floats = "std_msgs/msg/Float64MultiArray"
    size = {"width": 32, "height": 24}
    sim = hopper(
        {
            "reading": declared("reading", floats, ["felt", "bent"]),
            "readings": declared("reading", "float64[4]", ["felt", "bent"]),
            "force": declared("contacts", floats, ["foot", "torso"]),
            "forces": declared("contacts", "float64[2]", ["foot", "torso"]),
            "scan": declared("lidar", "sensor_msgs/msg/LaserScan", "imu", beams=9),
            "ranges": declared("lidar", "float32[9]", "imu"),
            "image": declared("camera", "sensor_msgs/msg/Image", "eye", **size),
            "pixels": declared("camera", "uint8[24,32,3]", "eye"),
            "deep": declared("depth", "sensor_msgs/msg/Image", "eye", **size),
            "depth": declared("depth", "float32[24,32]", "eye", **size),
        }
    )
    for _ in range(30):
        sim.step_to_next()
        seen = {name: sim.read(name) for name in sim._world.schedule}
    assert seen["forces"].any()
    assert seen["pixels"].any()
    for message, field, packet in (
        ("reading", "data", "readings"),
        ("force", "data", "forces"),
        ("scan", "ranges", "ranges"),
        ("image", "data", "pixels"),
        ("deep", "data", "depth"),
    ):
        assert array.tobytes(getattr(seen[message], field)) == seen[packet].tobytes(), packet


# ---------------------------------------------------------------------- commands


@pytest.mark.parametrize("type_", ["float64[2]", "float32[2]", "std_msgs/msg/Float64MultiArray"])
def test_all_actuators_are_driven_in_the_order_of_the_model(type_: str) -> None:
    sim = hopper({}, {"control": (type_, {"actuators": "all"})})
    values = np.array([0.25, -0.5])
    message = SimulatedNode({"control": (type_, {})}).make_packet("control")
    if "MultiArray" in type_:
        message.data = array("d", values)
    else:
        message[:] = values
    sim.command("control", message)
    assert sim.data.ctrl.tolist() == [0.25, -0.5]


def test_named_actuators_are_driven_in_their_order() -> None:
    sim = hopper({}, {"lift": ("float64[1]", {"actuator": "lift"})})
    sim.command("lift", np.array([0.75]))
    assert sim.data.ctrl.tolist() == [0.0, 0.75]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_command_is_finite(value: float) -> None:
    sim = hopper({})
    with pytest.raises(ModelError, match="control: a command must be a finite number, not"):
        sim.command("control", np.array([0.0, value]))


# ---------------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("outputs", "text"),
    [
        (
            {"seen": data("float64[7]", "qpos", "qvel")},
            r"robot.json: /outputs/0/mujoco: qpos, qvel fill float64\[6\], but output 'seen' is a"
            r" float64\[7\]",
        ),
        (
            {"seen": data("float64[6]", "qpos", "qvle")},
            r"/outputs/0/mujoco/element: 'qvle' is neither an array of mjData nor a part of one, as"
            r" 'qpos\[2:\]' \(did you mean 'qvel'\?\)",
        ),
        ({"seen": data("float64[6]", "qpos[2]")}, r"'qpos\[2\]' is neither an array of mjData"),
        ({"seen": data("float64[6]", "efc_force")}, "'efc_force' is neither an array of mjData"),
        (
            {"seen": data("std_msgs/msg/Float64MultiArray", "qpos")},
            r"'data' fills float64\[...\] or float32\[...\], but output 'seen' is a std_msgs",
        ),
        ({"seen": data("int32[3]", "qpos")}, r"but output 'seen' is a int32\[3\]"),
        ({"seen": declared("data", "float64[3]")}, "/element: missing: name the element"),
        (
            {"seen": declared("imu", "float64[3]", "imu")},
            r"'imu' fills sensor_msgs/msg/Imu, but output 'seen' is a float64\[3\]",
        ),
        (
            {"seen": declared("reading", "float64[3]", ["felt", "bent"])},
            r"the readings fill float64\[4\], but output 'seen' is a float64\[3\]",
        ),
        (
            {"seen": declared("camera", "uint8[24,32]", "eye")},
            r"pixels fill uint8\[24,32,3\], but output 'seen' is a uint8\[24,32\]",
        ),
        (
            {"seen": declared("camera", "uint8[24,32,3]", "eye", width=640)},
            r"pixels fill uint8\[24,640,3\], but output 'seen' is a uint8\[24,32,3\]",
        ),
        (
            {"seen": declared("camera", "float32[2,2,3]", "eye")},
            r"fills sensor_msgs/msg/Image or u",
        ),
        ({"seen": declared("lidar", "float32[1]", "imu")}, "1 is not a number of beams from 2"),
    ],
)
def test_a_wrong_sensor_is_told_by_its_place(outputs: Any, text: str) -> None:
    with pytest.raises(ModelError, match=text):
        hopper(outputs)


@pytest.mark.parametrize(
    ("type_", "keys", "text"),
    [
        (
            "float64[3]",
            {"actuators": "all"},
            r"/inputs/0/mujoco/actuators: a float64\[3\] does not fit the 2 actuators of the model",
        ),
        ("float64[1,2]", {"actuators": "all"}, r"a float64\[1,2\] does not fit the 2 actuators"),
        ("float64[2]", {"actuators": ["lift"]}, r"a float64\[2\] does not fit 1 actuators"),
        ("float64[2]", {"actuator": "all"}, "does not fit 1 actuators"),
        ("int32[2]", {"actuators": "all"}, r"input 'control' is a int32\[2\]; a command is"),
        ("std_msgs/msg/Float64", {"actuators": "all"}, "drives 1 actuators, not all"),
        ("float64[2]", {"actuators": "every"}, "'every' is not a list of names"),
    ],
)
def test_a_wrong_command_is_told_by_its_place(type_: str, keys: Any, text: str) -> None:
    with pytest.raises(ModelError, match=text):
        hopper({}, {"control": (type_, keys)})


def test_the_page_names_every_array() -> None:
    page = (Path(__file__).parents[2] / "docs" / "simulators.md").read_text("utf-8")
    assert [name for name in (*STATE, *_COMPUTED) if f"`{name}`" not in page] == []
