"""Runs in virtual time: what happens, and when, follows from declared times alone."""

from __future__ import annotations

import os
import threading
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from std_msgs.msg import Float64, String

import neuros
from neuros.errors import NeurosError, ProjectError, UsageError
from neuros.hooks import (
    All,
    Optional,
    neuros_function,
    neuros_initialise,
    neuros_tick,
)
from neuros.runtime.virtual_ros import VirtualSendingLink
from neuros.simulators.mujoco import MuJoCo
from neuros.time import to_nanoseconds

FLOAT = "std_msgs/msg/Float64"
MS = 1_000_000


def ns(node: Any) -> int:
    now = node.now()
    return int(now.sec * 1_000_000_000 + now.nanosec)


@neuros_tick(seconds=0.01, outputs="x")
def tick(node: Any) -> Any:
    packet = node.make_packet("x")
    packet.data = float(ns(node))
    return packet


@neuros_tick(seconds=0.01, outputs="x")
def tick_to_the_end(node: Any) -> Any:
    """Ends the run at END_MS, SLEEP_S late on the clock of the machine."""
    now = node.now()
    if now.sec * 1000 + now.nanosec / 1e6 >= float(os.environ["END_MS"]):
        time.sleep(float(os.environ.get("SLEEP_S", "0")))
        node.shutdown(f"at {os.environ['END_MS']} ms")
    return node.make_packet("x")


@neuros_function(inputs="x")
def take(node: Any, x: Any) -> None: ...


class Log:
    """What a hook was called with, and when."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, Any]] = []
        self.is_over = False  # hooks that start while the run drains are not part of a test

    def note(self, node: Any, value: Any) -> None:
        if not self.is_over:
            self.calls.append((ns(node), value))

    @property
    def times_ms(self) -> list[float]:
        return [time / MS for time, _ in self.calls]


def receiver(log: Log) -> Callable[..., Any]:
    @neuros_function(inputs="x")
    def receive(node: Any, x: Any) -> None:
        log.note(node, x.data / MS)

    return receive


def source(plugin: Any = tick, **keys: Any) -> neuros.Node:
    return neuros.Node("a", plugin, outputs={"x": FLOAT}, **keys)


def sink(log: Log, name: str = "b", **keys: Any) -> neuros.Node:
    return neuros.Node(name, receiver(log), inputs={"x": FLOAT}, **keys)


def run(
    folder: Path, log: Log, nodes: list[neuros.Node], connections: list[Any], seconds: float
) -> None:
    """Let a project go freely for so many seconds of virtual time."""
    described = neuros.Project(nodes, connections, folder=folder, time="virtual")
    with described.session(backend="local") as session:
        session.run(duration_s=seconds)
        log.is_over = True


@dataclass
class Topic:
    """Stands in for a publisher: what it publishes, and for how many."""

    msg_type: Any
    readers: int = 1
    published: list[bytes] = field(default_factory=list)

    @property
    def handle(self) -> Any:
        return SimpleNamespace(publish_raw=self.published.append)

    def get_subscription_count(self) -> int:
        return self.readers


@pytest.mark.parametrize(
    ("topic", "carries"),
    [
        (Topic(String), True),
        (Topic(String, readers=2), False),  # the other reads messages as ROS serialises them
        (Topic(Float64), False),  # DDS has room for 8 bytes
    ],
)
def test_a_packet_carries_states_of_nodes_if_only_its_receiver_reads_it(
    topic: Topic, carries: bool
) -> None:
    connection: Any = SimpleNamespace(is_jpeg=False)
    unused: Any = None
    link = VirtualSendingLink(connection, unused, unused, unused, array("Q"), topic)
    link._publish = link.publish
    assert link.publish_with(b"\0\1\0\0packet", b"") is False
    assert link.publish_with(b"\0\1\0\0packet", b"states") is carries
    plain, second = topic.published
    assert plain == b"\0\1\0\0packet"
    assert second.endswith(plain)
    assert (b"states" in second) is carries


# ---------------------------------------------------------------------- when something happens


def test_a_packet_arrives_one_delay_after_its_hook_has_ended(tmp_path: Path) -> None:
    log = Log()
    a, b = source(durations={"tick": 0.002}), sink(log)
    run(tmp_path, log, [a, b], [neuros.Connection(a["x"], b["x"], delay=0.003)], 0.05)
    assert log.calls == [(15 * MS, 10.0), (25 * MS, 20.0), (35 * MS, 30.0), (45 * MS, 40.0)]


def test_a_delay_is_100_microseconds_by_default(tmp_path: Path) -> None:
    log = Log()
    a, b = source(), sink(log)
    run(tmp_path, log, [a, b], [a["x"] >> b["x"]], 0.015)
    assert log.times_ms == [10.1]


def test_what_arrives_while_a_hook_takes_time_waits_and_the_newest_counts(tmp_path: Path) -> None:
    log = Log()
    a, b = source(), sink(log, durations={"receive": 0.025})
    run(tmp_path, log, [a, b], [neuros.Connection(a["x"], b["x"], delay=0.001)], 0.1)
    # 11 starts on 10; 21 and 31 arrive; at 36 the newest is 30, and so on.
    assert log.calls == [
        (11 * MS, 10.0),
        (36 * MS, 30.0),
        (61 * MS, 60.0),
        (86 * MS, 80.0),
    ]


def test_a_slow_receiver_holds_a_lossless_sender_back(tmp_path: Path) -> None:
    log = Log()
    a, b = source(), sink(log, durations={"receive": 0.025})
    lossless = neuros.Connection(a["x"], b["x"], discard_limit=0, delay=0.001)
    run(tmp_path, log, [a, b], [lossless], 0.1)
    # The tick of 20 waits for the acknowledgement of the packet of 10: 10 + 1 + 1 ms. That of 30
    # waits until the packet of 20 is started on, at 36, and its acknowledgement is there.
    assert log.calls == [(11 * MS, 10.0), (36 * MS, 20.0), (61 * MS, 37.0), (86 * MS, 62.0)]


def test_packets_of_a_connection_never_overtake_each_other(tmp_path: Path) -> None:
    log = Log()
    a, b = source(), sink(log)
    wire = neuros.Connection(a["x"], b["x"], delay={"uniform": [0.001, 0.05]}, queue_size=100)
    run(tmp_path, log, [a, b], [wire], 1.0)
    values = [value for _, value in log.calls]
    assert values == sorted(values)
    assert len(values) > 90
    assert len({time / MS - value for time, value in log.calls}) > 20


def test_at_one_instant_all_arrivals_come_before_a_hook_in_the_order_of_the_project(
    tmp_path: Path,
) -> None:
    log = Log()

    @neuros_function(inputs=All("x"))
    def both(node: Any, x: list[Any]) -> None:
        log.note(node, [each.data / MS for each in x])

    a = source()
    c = neuros.Node("c", tick, outputs={"x": FLOAT}, durations={"tick": 0.001})
    b = neuros.Node("b", both, inputs={"x": FLOAT})
    # Both arrive at 13 ms: the one from c is one of 10 ms that left at 11.
    wires = [
        neuros.Connection(c["x"], b["x"], delay=0.002),
        neuros.Connection(a["x"], b["x"], delay=0.003),
    ]
    run(tmp_path, log, [a, c, b], wires, 0.03)
    assert log.calls == [(13 * MS, [10.0, 10.0]), (23 * MS, [20.0, 20.0])]


def test_a_plain_input_takes_packets_of_one_instant_in_the_order_of_the_project(
    tmp_path: Path,
) -> None:
    log = Log()

    def sender(name: str, value: float) -> neuros.Node:
        @neuros_tick(seconds=0.01, outputs="x")
        def send(node: Any) -> Any:
            packet = node.make_packet("x")
            packet.data = value * MS
            return packet

        return neuros.Node(name, send, outputs={"x": FLOAT})

    first, second, b = sender("zoe", 1.0), sender("adam", 2.0), sink(log)
    run(tmp_path, log, [second, b, first], [first["x"] >> b["x"], second["x"] >> b["x"]], 0.015)
    assert [value for _, value in log.calls] == [1.0, 2.0]


def test_a_tick_that_is_due_at_an_instant_follows_its_arrivals(tmp_path: Path) -> None:
    log = Log()

    @neuros_tick(seconds=0.011)
    def beat(node: Any) -> None:
        log.note(node, "beat")

    @neuros_function(inputs="x")
    def receive(node: Any, x: Any) -> None:
        log.note(node, "packet")

    a = source()
    b = neuros.Node("b", [beat, receive], inputs={"x": FLOAT})
    run(tmp_path, log, [a, b], [neuros.Connection(a["x"], b["x"], delay=0.001)], 0.0115)
    # Both are ready at 11 ms: the order is that of declaration, since none has run before.
    assert log.calls == [(11 * MS, "beat"), (11 * MS, "packet")]


def test_ticks_that_a_long_hook_hides_coalesce(tmp_path: Path) -> None:
    log = Log()

    @neuros_tick(seconds=0.01)
    def slow(node: Any) -> None:
        log.note(node, None)

    a = neuros.Node("a", slow, durations={"slow": 0.025})
    run(tmp_path, log, [a], [], 0.1)
    assert log.times_ms == [10, 35, 60, 85]


def test_a_hook_that_steps_a_simulator_takes_the_simulated_time(tmp_path: Path) -> None:
    log = Log()

    class World:
        time_s = 0.0

    world = World()

    @neuros_initialise()
    def begin(node: Any) -> None:
        world.time_s = 0.0
        node.own_simulated_time(lambda: world.time_s)

    @neuros_function(outputs="x")
    def step(node: Any) -> Any:
        world.time_s += 0.02
        return node.make_packet("x")

    a = neuros.Node(
        "a",
        [begin, step],
        outputs={"x": FLOAT, "clock": "rosgraph_msgs/msg/Clock"},
    )
    run(tmp_path, log, [a, b := sink(log)], [a["x"] >> b["x"]], 0.07)
    assert log.times_ms == [20.1, 40.1, 60.1]


def test_packets_of_a_node_to_itself_arrive_at_the_end_of_the_hook(tmp_path: Path) -> None:
    log = Log()

    @neuros_tick(seconds=0.01, outputs="x")
    def send(node: Any) -> Any:
        packet = node.make_packet("x")
        packet.data = float(ns(node))
        return packet

    own = receiver(log)
    a = neuros.Node(
        "a", [send, own], inputs={"x": FLOAT}, outputs={"x": FLOAT}, durations={"send": 0.004}
    )
    run(tmp_path, log, [a], [a["x"] >> a["x"]], 0.025)
    assert log.calls == [(14 * MS, 10.0), (24 * MS, 20.0)]


WORLD = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody><body><joint name="turn" axis="0 0 1"/><geom size=".1"/></body></worldbody>
</mujoco>
"""


def test_physics_that_runs_by_itself_follows_the_virtual_clock(tmp_path: Path) -> None:
    log = Log()

    @neuros_initialise()
    def begin(node: Any) -> None:
        MuJoCo(node, WORLD).run_asynchronous(0.5)

    sensor = {"sensor": "clock", "rate": 50}
    a = neuros.Node(
        "a",
        begin,
        outputs={"clock": {"type": "rosgraph_msgs/msg/Clock", "mujoco": sensor}},
    )

    @neuros_function(inputs="clock")
    def receive(node: Any, clock: Any) -> None:
        log.note(node, to_nanoseconds(clock) / MS)

    b = neuros.Node("b", receive, inputs={"clock": "rosgraph_msgs/msg/Clock"})
    run(tmp_path, log, [a, b], [neuros.Connection(a["clock"], b["clock"], delay=0.001)], 0.2)
    # 20 ms of simulated time take 40 ms. The first packet waits for the begin of the run, since a
    # session holds what sends, not what computes.
    assert [value for _, value in log.calls] == [20, 40, 60, 80, 100]


def test_physics_as_fast_as_possible_takes_no_time(tmp_path: Path) -> None:
    @neuros_initialise()
    def begin(node: Any) -> None:
        MuJoCo(node, WORLD).run_asynchronous(None)

    sensor = {"sensor": "clock", "rate": 50}
    clock = {"type": "rosgraph_msgs/msg/Clock", "mujoco": sensor}
    found = fails(tmp_path, [neuros.Node("a", begin, outputs={"clock": clock})], [])
    assert "run_asynchronous(None) takes no virtual time: give a real_time_factor" in found


# ---------------------------------------------------------------------- draws


def lossy(folder: Path, seed: str) -> list[tuple[int, Any]]:
    log = Log()
    a = source(environment={"SEED": seed}, durations={"tick": {"normal": [0.002, 0.001]}})
    b = sink(log, durations={"receive": {"lognormal": [0.008, 0.5]}})
    wire = neuros.Connection(a["x"], b["x"], delay={"uniform": [0.001, 0.009]}, loss=0.3)
    run(folder, log, [a, b], [wire], 2.0)
    return log.calls


def test_a_run_depends_on_its_seed_and_on_nothing_else(tmp_path: Path) -> None:
    first = lossy(tmp_path, "1")
    assert lossy(tmp_path, "1") == first
    assert lossy(tmp_path, "2") != first
    assert 100 < len(first) < 160  # of 200


def test_losses_are_counted(tmp_path: Path) -> None:
    log = Log()
    a, b = source(), sink(log)
    described = neuros.Project(
        [a, b], [neuros.Connection(a["x"], b["x"], loss=0.25)], folder=tmp_path, time="virtual"
    )
    with described.session(backend="local") as session:
        session.run(duration_s=10.0)
        record = session.close().record
    (connection,) = record["connections"]
    assert connection["sent"] == connection["received"] + connection["lost"]
    assert 200 < connection["lost"] < 300
    assert connection["consumed"] == connection["received"] == len(log.calls)


def test_a_run_beside_busy_threads_is_the_same(tmp_path: Path) -> None:
    alone = lossy(tmp_path, "7")
    is_over = threading.Event()
    threads = [threading.Thread(target=lambda: sum(iter(is_over.is_set, True))) for _ in range(3)]
    for thread in threads:
        thread.start()
    try:
        assert lossy(tmp_path, "7") == alone
    finally:
        is_over.set()
        for thread in threads:
            thread.join()


# ---------------------------------------------------------------------- sessions


def test_a_session_steps_pauses_and_goes_on_in_virtual_time(tmp_path: Path) -> None:
    log = Log()
    a, b = source(durations={"tick": 0.002}), sink(log)
    described = neuros.Project([a, b], [a["x"] >> b["x"]], folder=tmp_path, time="virtual")
    with described.session(backend="local") as session:
        session.step(3)
        assert len(log.calls) == 3
        in_steps = log.calls[-1][0]
        session.run(duration_s=0.1)
        assert log.calls[-1][0] - in_steps == pytest.approx(100 * MS, abs=12 * MS)


def test_a_reset_begins_anew_at_time_0_with_the_same_draws(tmp_path: Path) -> None:
    log = Log()
    a = source(environment={"SEED": "1"})
    b = sink(log, durations={"receive": {"normal": [0.02, 0.01]}})
    wire = neuros.Connection(a["x"], b["x"], delay={"uniform": [0.001, 0.02]}, loss=0.2)
    described = neuros.Project([a, b], [wire], folder=tmp_path, time="virtual")
    episodes = []
    with described.session(backend="local") as session:
        for seed in (None, 1, 2, 1):
            if seed is not None:
                session.reset(seed=seed)
            log.calls.clear()
            session.run(duration_s=0.5)
            episodes.append([*log.calls])
    assert episodes[0] == episodes[1] == episodes[3] != episodes[2]


# ---------------------------------------------------------------------- the end


def test_a_run_ends_after_its_duration_of_virtual_time(tmp_path: Path) -> None:
    described = ticking(tmp_path, time="virtual")
    ended = described.run(backend="in-process", duration=60, output=tmp_path / "run")
    record = ended.record
    assert record["exit_code"] == 0
    assert record["reason"] == "60 s of virtual time have passed"
    assert record["virtual_s"] == 60.0
    assert record["nodes"]["a"]["hooks"]["tick"]["executions"] == 5999


def test_the_end_that_a_hook_asks_for_reaches_the_others_after_100_ms(tmp_path: Path) -> None:
    @neuros_tick(seconds=0.01, outputs="x")
    def tick_to_50_ms(node: Any) -> Any:
        if ns(node) >= 50 * MS:
            node.shutdown("it was enough")
        return node.make_packet("x")

    @neuros_tick(seconds=0.01, inputs=Optional("x"))
    def look(node: Any, x: Any) -> None: ...

    a = source(tick_to_50_ms)
    b, alone = (neuros.Node(name, look, inputs={"x": FLOAT}) for name in ("b", "alone"))
    described = neuros.Project([a, b, alone], [a["x"] >> b["x"]], folder=tmp_path, time="virtual")
    with pytest.warns(UserWarning, match="input 'x' of node 'alone' is not connected"):
        ended = described.run(backend="in-process", output=tmp_path / "run")
    assert ended.reason.endswith("it was enough")
    executions = {
        name: [hook["executions"] for hook in node["hooks"].values()]
        for name, node in ended.record["nodes"].items()
    }
    assert executions == {"a": [5], "b": [14], "alone": [14]}  # the end comes before the 15th tick


@pytest.mark.parametrize("backend", ["in-process", "process"])
def test_the_first_node_that_asks_ends_the_run_and_at_one_instant_the_first_by_name(
    tmp_path: Path, backend: str
) -> None:
    def reason(*ends: dict[str, str]) -> str:
        nodes = [
            neuros.Node(name, tick_to_the_end, outputs={"x": FLOAT}, environment=end)
            for name, end in zip("cb", ends, strict=True)
        ]
        a = neuros.Node("a", take, inputs={"x": FLOAT})
        folder = tmp_path / f"{len([*tmp_path.iterdir()])}"
        folder.mkdir()
        wires = [node["x"] >> a["x"] for node in nodes]
        described = neuros.Project([*nodes, a], wires, folder=folder, time="virtual")
        return described.run(backend=backend, output=folder / "run").reason

    early, slowly = {"END_MS": "50"}, {"END_MS": "50", "SLEEP_S": "0.3"}
    assert reason(early, slowly) == "b ended the project: at 50 ms"
    assert reason(slowly, {"END_MS": "60"}) == "c ended the project: at 50 ms"


# ---------------------------------------------------------------------- what is refused


def fails(folder: Path, nodes: list[neuros.Node], wires: list[Any]) -> str:
    described = neuros.Project(nodes, wires, folder=folder, time="virtual")
    with pytest.raises(NeurosError) as error:
        described.session(backend="local").run(duration_s=1.0)
    return str(error.value)


def test_a_main_loop_that_steps_nothing_is_refused_when_it_is_met(tmp_path: Path) -> None:
    @neuros_function(outputs="clock")
    def step(node: Any) -> Any:
        return node.make_packet("clock")

    a = neuros.Node("a", step, outputs={"clock": "rosgraph_msgs/msg/Clock"})
    found = fails(tmp_path, [a], [])
    assert "hook 'step' of node 'a' starts unasked, and takes no virtual time" in found
    assert '"durations": {"step": 0.01}' in found


def test_a_ring_within_a_node_that_takes_no_time_is_refused(tmp_path: Path) -> None:
    @neuros_initialise(outputs="x")
    def begin(node: Any) -> Any:
        return node.make_packet("x")

    @neuros_function(inputs="x", outputs="x")
    def again(node: Any, x: Any) -> Any:
        return x

    a = neuros.Node("a", [begin, again], inputs={"x": FLOAT}, outputs={"x": FLOAT})
    found = fails(tmp_path, [a], [a["x"] >> a["x"]])
    assert "at one instant of virtual time: give one of them a duration" in found


def test_a_subscription_of_a_plugin_is_refused(tmp_path: Path) -> None:
    @neuros_initialise()
    def begin(node: Any) -> None:
        node.get_ros_node().create_timer(0.1, lambda: None)

    found = fails(tmp_path, [neuros.Node("a", begin)], [])
    assert "has made a subscription, timer, service or client of ROS" in found


def test_a_plugin_that_sends_from_a_thread_is_refused(tmp_path: Path) -> None:
    @neuros_initialise()
    def begin(node: Any) -> None:
        node.submit({"x": node.make_packet("x")}, lambda: False)

    a = neuros.Node("a", begin, outputs={"x": FLOAT})
    assert "sends from a thread of its plugin, which takes real time" in fails(tmp_path, [a], [])


TICKING = """
from neuros.hooks import neuros_tick

@neuros_tick(seconds=0.01)
def tick(node): ...
"""


def ticking(folder: Path, **keys: Any) -> neuros.Project:
    (folder / "p.py").write_text(TICKING)
    return neuros.Project([neuros.Node("a", "p.py")], folder=folder, **keys)


def test_nodes_elsewhere_are_refused(tmp_path: Path) -> None:
    described = ticking(tmp_path, time="virtual")
    with pytest.raises(UsageError, match="--network: nodes elsewhere are in real time"):
        described.run(backend="in-process", duration=1, network=True)


def test_a_pace_of_real_time_is_refused(tmp_path: Path) -> None:
    described = ticking(tmp_path)
    with pytest.raises(UsageError, match="add --time virtual"):
        described.run(backend="in-process", duration=1, real_time_factor=1.0)


@pytest.mark.parametrize("factor", [0, -1, float("nan"), float("inf"), "fast", True])
def test_a_pace_that_is_none_is_refused(tmp_path: Path, factor: Any) -> None:
    described = ticking(tmp_path, time="virtual")
    with pytest.raises(UsageError, match=r"--real-time-factor .*: give a number above 0"):
        described.run(backend="in-process", duration=1, real_time_factor=factor)


@pytest.mark.parametrize("backend", ["in-process", "process"])
def test_a_run_goes_no_faster_than_its_real_time_factor(tmp_path: Path, backend: str) -> None:
    described = ticking(tmp_path, time="virtual")
    paced, free = (
        described.run(
            backend=backend, duration=2, output=tmp_path / f"{factor}", real_time_factor=factor
        )
        for factor in (4.0, None)
    )
    assert paced.record["wall_s"] >= 0.49  # 2 s of virtual time in half a second
    assert paced.record["nodes"]["a"]["hooks"] == free.record["nodes"]["a"]["hooks"]


def test_a_main_loop_without_a_duration_is_refused_before_the_start(tmp_path: Path) -> None:
    @neuros_function(inputs=Optional("x"))
    def spin(node: Any, x: Any) -> None: ...

    a = neuros.Node("a", spin, inputs={"x": FLOAT})
    with pytest.raises(ProjectError, match="starts unasked, and takes no virtual time"):
        neuros.Project([a], folder=tmp_path, time="virtual").session(backend="local")
