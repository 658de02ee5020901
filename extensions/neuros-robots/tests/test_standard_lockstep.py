"""A node steps any simulator that serves ``simulation_interfaces``, in lockstep.

The simulator here is a list of what it was asked, with answers that a test chooses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from neuros_robots.standard.lockstep import Lockstep
from neuros_robots.standard.settings import CHECK, Settings

from neuros.errors import NodeError
from neuros.project.model import Node, Port
from neuros.time import set_stamp
from neuros.transport.messages import make_packet

POSE = "geometry_msgs/msg/PoseStamped"
IMU = "sensor_msgs/msg/Imu"
CLOCK = "rosgraph_msgs/msg/Clock"
FLOAT = "std_msgs/msg/Float64"
FEATURES = (
    *("STEP_SIMULATION_SINGLE", "STEP_SIMULATION_MULTIPLE", "SIMULATION_RESET"),
    *("SIMULATION_STATE_PAUSE", "ENTITY_STATE_GETTING", "ENTITY_STATE_SETTING"),
)


class State(SimpleNamespace):
    """An ``EntityState``."""

    def __init__(self) -> None:
        pose, twist = (make_packet(f"geometry_msgs/msg/{kind}") for kind in ("Pose", "Twist"))
        super().__init__(header=make_packet("std_msgs/msg/Header"), pose=pose, twist=twist)


def kinds(*, is_newer: bool = True) -> SimpleNamespace:
    """The messages of the standard, as far as a node uses them."""
    flags = {"set_pose": False, "set_twist": False} if is_newer else {}
    return SimpleNamespace(
        msg=SimpleNamespace(
            SimulatorFeatures=SimpleNamespace(**{name: name for name in FEATURES}),
            SimulationState=Paused,
            EntityState=State,
        ),
        srv=SimpleNamespace(
            SetEntityState=SimpleNamespace(Request=lambda: SimpleNamespace(**flags))
        ),
    )


class Paused(SimpleNamespace):
    STATE_PAUSED = 2


class Simulator:
    """Plays the simulator: its time goes on by ``step_s`` with each step."""

    def __init__(self, features: tuple[str, ...] = FEATURES, step_s: float = 0.002) -> None:
        self.types = kinds()
        self.features, self.step_s = features, step_s
        self.steps = 0
        self.asked: list[str] = []
        self.fields: dict[str, dict[str, Any]] = {}
        self.has_stamps = True
        self.messages: deque[Any] = deque()
        self.on_step: Callable[[], object] = lambda: None

    def call(self, kind: str, accepts: tuple[str, ...] = (), **fields: Any) -> Any:
        self.asked.append(kind)
        self.fields[kind] = fields
        if kind == "ResetSimulation":
            self.steps = 0
        if kind == "StepSimulation":
            self.steps += fields["steps"]
            self.on_step()
        state = State()
        if self.has_stamps:
            set_stamp(state.header.stamp, self.now_ns)
        state.pose.position.x = float(self.steps)
        state.twist.linear.x = 7.0
        return SimpleNamespace(features=SimpleNamespace(features=self.features), state=state)

    @property
    def now_ns(self) -> int:
        return round(self.steps * self.step_s * 1e9)

    def join_topics(self) -> None:
        self.asked.append("join")

    def forget(self) -> None:
        self.messages.clear()

    def publish(self, name: str, packet: Any) -> None:
        self.asked.append(f"publish {name} {packet.data:g}")

    def take(self, name: str, is_wanted: Callable[[Any], bool], what: str) -> Any:
        while self.messages:
            if is_wanted(message := self.messages.popleft()):
                return message
        raise NodeError(f"{name}: no {what}")

    def sense(self, time_s: float) -> None:
        """Publish a reading of the IMU."""
        imu = make_packet(IMU)
        set_stamp(imu.header.stamp, round(time_s * 1e9))
        self.messages.append(imu)


def node_of(
    inputs: dict[str, str] | None = None, outputs: dict[str, str] | None = None, **parameters: Any
) -> Node:
    def ports(types: dict[str, str]) -> tuple[Port, ...]:
        return tuple(Port(name, kind) for name, kind in types.items())

    return Node(
        name="robot",
        container="neuros_python",
        plugin=Path("robot.py"),
        inputs=ports(inputs or {}),
        outputs=ports({"pose": POSE} if outputs is None else outputs),
        parameters={"step_s": 0.002, **parameters},
        file=Path("robot.json"),
    )


def lockstep(simulator: Simulator, node: Node | None = None, **parameters: Any) -> Lockstep:
    node = node or node_of(**{"steps": 10, "entities.pose": "body", **parameters})
    types = {port.name: port.type for port in node.outputs}
    handle = SimpleNamespace(
        description=node, virtual_time=None, make_packet=lambda name: make_packet(types[name])
    )
    return Lockstep(handle, Settings.of(node), simulator)


class TestSteps:
    def test_it_is_paused_and_reset_and_then_stepped_so_often_for_each_start(self) -> None:
        simulator = Simulator()
        stepped = lockstep(simulator)
        stepped.begin()
        first, second = stepped.step({}), stepped.step({})
        assert simulator.asked == [
            *("GetSimulatorFeatures", "join", "SetSimulationState", "ResetSimulation"),
            *("StepSimulation", "GetEntityState") * 2,
        ]
        assert [packet.pose.position.x for packet in (*first, *second)] == [10.0, 20.0]
        assert stepped.time_s == 0.04

    def test_a_simulator_that_makes_one_step_at_a_time_is_asked_ten_times(self) -> None:
        simulator = Simulator(tuple(n for n in FEATURES if n != "STEP_SIMULATION_MULTIPLE"))
        stepped = lockstep(simulator)
        stepped.begin()
        stepped.step({})
        assert simulator.asked.count("StepSimulation") == 10
        assert stepped.time_s == 0.02

    def test_a_reset_begins_anew(self) -> None:
        simulator = Simulator()
        stepped = lockstep(simulator)
        stepped.begin()
        once = stepped.step({})
        stepped.begin()
        assert stepped.time_s == 0
        assert stepped.step({}) == once

    def test_a_clock_has_the_time_and_needs_no_topic(self) -> None:
        stepped = lockstep(Simulator(), node_of(outputs={"clock": CLOCK}, steps=5))
        stepped.begin()
        (clock,) = stepped.step({})
        assert (clock.clock.sec, clock.clock.nanosec) == (0, 10_000_000)

    def test_without_a_reset_time_begins_with_that_of_the_simulator(self) -> None:
        simulator = Simulator()
        simulator.steps = 500
        stepped = lockstep(simulator, reset=False)
        stepped.begin()
        stepped.step({})
        assert "ResetSimulation" not in simulator.asked
        assert stepped.time_s == 1.02

    def test_a_state_without_a_stamp_gets_the_time_of_the_node(self) -> None:
        simulator = Simulator()
        simulator.has_stamps = False
        stepped = lockstep(simulator)
        stepped.begin()
        (packet,) = stepped.step({})
        assert packet.header.stamp.nanosec == 20_000_000


class TestInputs:
    def test_a_command_is_published_before_the_steps(self) -> None:
        simulator = Simulator()
        node = node_of({"command": FLOAT}, {}, **{"topics.command": "/command"})
        stepped = lockstep(simulator, node)
        stepped.begin()
        command = make_packet(FLOAT)
        command.data = 0.5
        stepped.step({"command": command})
        assert simulator.asked[-2:] == ["publish command 0.5", "StepSimulation"]

    def test_a_pose_sets_the_pose_of_an_entity_and_nothing_else(self) -> None:
        simulator = Simulator()
        stepped = lockstep(simulator, node_of({"goal": POSE}, {}, **{"entities.goal": "box"}))
        stepped.begin()
        goal = make_packet(POSE)
        goal.pose.position.x = 3.0
        stepped.step({"goal": goal})
        asked = simulator.fields["SetEntityState"]
        assert (asked["entity"], asked["set_pose"]) == ("box", True)
        assert "set_twist" not in asked
        assert asked["state"].pose.position.x == 3.0

    def test_before_2_1_which_sets_everything_the_rest_stays_as_it_is(self) -> None:
        simulator = Simulator()
        simulator.types = kinds(is_newer=False)
        stepped = lockstep(simulator, node_of({"goal": POSE}, {}, **{"entities.goal": "box"}))
        stepped.begin()
        stepped.step({"goal": make_packet(POSE)})
        asked = simulator.fields["SetEntityState"]
        assert {*asked} == {"entity", "state"}
        assert asked["state"].twist.linear.x == 7.0

    def test_an_optional_input_without_a_packet_changes_nothing(self) -> None:
        simulator = Simulator()
        ports = {"topics.command": "/command", "optional": ("command",)}
        stepped = lockstep(simulator, node_of({"command": FLOAT}, {}, **ports))
        stepped.begin()
        stepped.step({"command": None})
        assert simulator.asked[-1] == "StepSimulation"


class TestTopics:
    def imu(self, simulator: Simulator, **parameters: Any) -> Lockstep:
        node = node_of(outputs={"imu": IMU}, steps=10, **{"topics.imu": "/imu"}, **parameters)
        stepped = lockstep(simulator, node)
        stepped.begin()
        return stepped

    def test_the_message_of_now_is_sent_and_older_ones_are_dropped(self) -> None:
        simulator = Simulator()
        stepped = self.imu(simulator)
        simulator.on_step = lambda: [simulator.sense(time_s) for time_s in (0.018, 0.02)]
        (packet,) = stepped.step({})
        assert packet.header.stamp.nanosec == 20_000_000

    def test_one_message_in_five_starts(self) -> None:
        simulator = Simulator()
        stepped = self.imu(simulator, **{"every.imu": 5})
        simulator.on_step = lambda: simulator.steps == 50 and simulator.sense(0.1)
        found = [stepped.step({})[0] for _ in range(5)]
        assert [packet is not None for packet in found] == [False] * 4 + [True]

    def test_what_was_under_way_before_the_reset_is_dropped(self) -> None:
        simulator = Simulator()
        stepped = self.imu(simulator)
        simulator.sense(17.3)
        simulator.on_step = lambda: simulator.sense(0.02)
        (packet,) = stepped.step({})
        assert packet.header.stamp.nanosec == 20_000_000

    def test_a_message_of_later_says_that_the_step_is_another_one(self) -> None:
        simulator = Simulator()
        stepped = self.imu(simulator)
        simulator.on_step = lambda: simulator.sense(simulator.steps * 0.002)
        stepped.step({})
        simulator.on_step = lambda: simulator.sense(simulator.steps * 0.004)
        with pytest.raises(
            NodeError, match=r"'imu': /imu brings a message of 0.08 s, and it is 0.04"
        ):
            stepped.step({})


class TestSimulatorsThatDoNotFit:
    def test_all_features_that_are_missing_are_named_at_once(self) -> None:
        node = node_of({"goal": POSE}, **{"entities.pose": "body", "entities.goal": "box"})
        with pytest.raises(NodeError) as error:
            lockstep(Simulator(("SIMULATION_STATE_PAUSE",)), node).begin()
        for name in FEATURES:
            is_needed = name not in ("STEP_SIMULATION_MULTIPLE", "SIMULATION_STATE_PAUSE")
            assert (name in str(error.value)) is is_needed
        assert '"reset": false does without' in str(error.value)

    def test_a_simulator_with_another_time_step(self) -> None:
        stepped = lockstep(Simulator(step_s=0.005))
        stepped.begin()
        with pytest.raises(NodeError, match=r"time is 0.05 s, and 0.02 s is expected: 'step_s'"):
            stepped.step({})

    def test_a_simulator_that_somebody_else_steps(self) -> None:
        simulator = Simulator()
        stepped = lockstep(simulator)
        stepped.begin()
        stepped.step({})
        simulator.call("StepSimulation", steps=1)
        with pytest.raises(NodeError, match="nobody else may step it"):
            stepped.step({})

    def test_without_reset_and_entity_nobody_knows_the_time(self) -> None:
        stepped = lockstep(Simulator(), node_of(outputs={"clock": CLOCK}, reset=False))
        with pytest.raises(NodeError, match="name one in 'entities', or leave out 'reset'"):
            stepped.begin()


@pytest.mark.parametrize(
    ("changes", "texts"),
    [
        ({"entities.pose": "body"}, []),
        ({}, ["output 'pose' has no entity and no topic"]),
        ({"entities.pose": "a", "topics.pose": "/a"}, ["has both an entity and a topic"]),
        ({"entities.pose": ""}, ["found '', expected the name of an entity"]),
        ({"entities.pose": "a", "steps": 0}, ["steps of the simulator in one start of the hook"]),
        ({"entities.pose": "a", "steps": 2.5}, ["found 2.5"]),
        ({"entities.pose": "a", "step_s": 0.0}, ["found 0.0, expected simulated seconds"]),
        ({"entities.pose": "a", "step_s": float("inf")}, ["found inf"]),
        ({"entities.pose": "a", "timeout_s": -1}, ["found -1, expected seconds of the wall clock"]),
        ({"entities.pose": "a", "domain": 300}, ["found 300, expected a ROS domain, 0 to 232"]),
        ({"entities.pose": "a", "reset": 1}, ["found 1, expected true or false"]),
        ({"entities.pose": "a", "stepps": 3}, ["did you mean 'steps'?"]),
        ({"entities.pose": "a", "topics": "/imu"}, ["there is no such parameter"]),
        ({"entities.pose": "a", "optional": ("pose",)}, ["the node has no input 'pose'"]),
        ({"entities.pose": "a", "every.pose": 2}, ["no output with a topic 'pose'"]),
        (
            {"entities.pos": "a", "simulator": 3},
            ["no entity and no topic", "has no port 'pos' (did you mean 'pose'?)", "'/gz_server'"],
        ),
    ],
)
def test_mistakes_in_parameters_are_all_named_before_the_run(
    changes: dict[str, Any], texts: list[str]
) -> None:
    problems = [problem.text for problem in CHECK.problems(node_of(**changes))]
    assert len(problems) == len(texts), problems
    for text in texts:
        assert any(text in problem for problem in problems), problems


def test_a_missing_time_step_and_ports_that_cannot_be() -> None:
    node = node_of({"same": IMU}, {"same": IMU, "clock": CLOCK}, **{"entities.same": "body"})
    node = Node(**{**vars(node), "parameters": {"entities.same": "body", "topics.clock": "/clock"}})
    problems = "\n".join(problem.text for problem in CHECK.problems(node))
    assert "is missing: simulated seconds of one step" in problems
    assert f"{POSE}, geometry_msgs/msg/TwistStamped, not of {IMU}" in problems
    assert "output 'clock' is the clock, which needs no entity and no topic" in problems
    assert "'same' is an input and an output" in problems


def test_an_external_topic_is_refused_since_it_does_not_wait() -> None:
    port = Port("imu", IMU, external_topic="/imu")
    node = Node(**{**vars(node_of(**{"topics.imu": "/imu"})), "outputs": (port,)})
    (problem,) = CHECK.problems(node)
    assert "has an external topic, which does not wait for the simulator" in problem.text


@pytest.mark.parametrize(
    ("simulator", "name"),
    [("", "/step_simulation"), ("/", "/step_simulation"), ("gz", "/gz/step_simulation"),
     ("/gz_server/", "/gz_server/step_simulation"), ("/a/b", "/a/b/step_simulation")],
)  # fmt: skip
def test_names_of_services(simulator: str, name: str) -> None:
    assert Settings(0.001, simulator=simulator).service("step_simulation") == name
