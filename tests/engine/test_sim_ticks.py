"""Ticks by simulated time: at whole numbers of periods, by the packets of the node's clock.

They run on the real engine, in a harness that plays the nodes around.
"""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from neuros.engine.sim_clock import Periods
from neuros.errors import HookError
from neuros.testing import PluginHarness, wire
from neuros.time import to_seconds, to_stamp

CLOCK = "rosgraph_msgs/msg/Clock"
NUMBER = "std_msgs/msg/Float64"
PLUGIN = """
from neuros.hooks import neuros_function, neuros_tick
from std_msgs.msg import Float64
from neuros.time import to_seconds

@neuros_tick(sim_seconds={period}, outputs="at")
def tick(node):
    return Float64(data=node.sim_time)

@neuros_function(inputs="ask", outputs="told")
def tell(node, ask):
    return Float64(data=to_seconds(node.now()))
"""


@pytest.fixture
def harness(tmp_path):
    def make(period=0.1, plugin=PLUGIN, inputs=("clock",), outputs=("at", "told"), **connection):
        file = tmp_path / "plugin.py"
        file.write_text(plugin.format(period=period))
        return PluginHarness(
            file,
            inputs={**dict.fromkeys(inputs, CLOCK), "ask": NUMBER},
            outputs=dict.fromkeys(outputs, NUMBER),
            connections=[wire("world.clock -> node.clock", **connection)] if connection else [],
            run_folder=tmp_path,
        )

    return make


def send(harness, *times_s):
    harness.send("clock", *(Clock(clock=to_stamp(time_s)) for time_s in times_s))
    harness.run()


def ticks(harness):
    return [packet.data for packet in harness.received("at")]


def steps(count, step_s=0.02):
    return [round(step_s * (number + 1), 9) for number in range(count)]


def test_a_tick_runs_at_every_whole_period_and_sees_that_time(harness):
    node = harness()
    send(node, *steps(26))
    assert ticks(node) == [0.1, 0.2, 0.3, 0.4, 0.5]


def test_where_no_packet_is_at_that_time_it_runs_at_the_next_and_does_not_drift(harness):
    node = harness(0.1)
    send(node, *steps(11, 0.03))
    assert ticks(node) == [0.12, 0.21, 0.3]


def test_periods_that_a_packet_jumps_over_are_one_tick_and_counted(harness):
    node = harness(0.1)
    send(node, 0.05, 0.45, 0.5)
    assert ticks(node) == [0.45, 0.5]
    hook = node._engine.all_hooks[0]
    assert (hook.name, hook.missed_ticks) == ("tick", 3)


def test_a_node_that_comes_late_waits_for_the_next_whole_period(harness):
    node = harness(0.1)
    send(node, 5.03, 5.08, 5.1)
    assert ticks(node) == [5.1]
    assert node._engine.all_hooks[0].missed_ticks == 0


def test_a_simulation_that_starts_anew_ticks_anew(harness):
    node = harness(0.1)
    send(node, 0.1, 0.2, 0.0, 0.1)
    assert ticks(node) == [0.1, 0.2, 0.1]


def test_where_its_packet_is_discarded_a_tick_looks_at_the_next_one(harness):
    node = harness(0.1, discard_limit=9, queue_size=2)
    node.block("at")
    send(node, 0.1, 0.2, 0.0, 0.02)  # 0.2 is discarded, and the simulation has started anew
    node.unblock("at")
    node.run()
    assert ticks(node) == [0.1]
    send(node, 0.1)
    assert ticks(node) == [0.1, 0.1]


def test_time_waits_for_a_tick_that_cannot_start(harness):
    """So a lossless clock loses no tick: the simulation stands still, too."""
    node = harness(0.1)
    node.block("at")
    send(node, *steps(15))
    assert ticks(node) == [0.1]  # the second is due, and its clock packet unread
    assert node.node.sim_time == 0.18
    assert node.unsent("clock") == 5
    assert node.explain() == [
        "waits for `ask` from sender",
        "is blocked on `node.at -> receiver.at` (1 outstanding, none acknowledged yet)",
    ]
    node.unblock("at")
    node.run()
    assert ticks(node) == [0.1, 0.2, 0.3]


def test_with_a_longer_queue_a_tick_still_sees_its_own_time(harness):
    node = harness(0.1, discard_limit=0, queue_size=8)
    node.block("at")
    send(node, 0.1, 0.2, 0.3)
    node.unblock("at")
    node.run()
    assert ticks(node) == [0.1, 0.2, 0.3]


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 6), st.integers(0, 4), st.lists(st.booleans(), min_size=7, max_size=7))
def test_ticks_are_the_same_however_long_the_queue_and_however_late_the_receiver(
    tmp_path_factory, queue_size, shift, is_late
):
    clock = wire("world.clock -> node.clock", discard_limit=0, queue_size=queue_size)
    file = tmp_path_factory.mktemp("late") / "plugin.py"
    file.write_text(PLUGIN.format(period=0.1))
    with PluginHarness(
        file,
        inputs={"clock": CLOCK, "ask": NUMBER},
        outputs={"at": NUMBER, "told": NUMBER},
        connections=[clock],
        run_folder=file.parent,
    ) as node:
        for step, time_s in enumerate(steps(30), shift):
            (node.block if is_late[step // 5] else node.unblock)("at")
            send(node, time_s)
        node.unblock("at")
        node.run()
        assert ticks(node) == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
        assert node._engine.all_hooks[0].missed_ticks == 0


def test_two_ticks_of_one_node_have_a_schedule_each(harness):
    plugin = PLUGIN + '\n@neuros_tick(sim_seconds=0.3, outputs="told")\ndef slow(node):\n'
    plugin += "    return Float64(data=node.sim_time)\n"
    node = harness(0.1, plugin)
    send(node, *steps(31))
    assert ticks(node) == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    assert [packet.data for packet in node.received("told")] == [0.3, 0.6]


def test_a_tick_may_take_the_clock_itself(harness):
    plugin = """
from neuros.hooks import neuros_tick
from std_msgs.msg import Float64
from neuros.time import to_seconds

@neuros_tick(sim_seconds={period}, inputs=["clock", "ask"], outputs="at")
def tick(node, clock, ask):
    return Float64(data=to_seconds(clock) + ask.data)
"""
    node = harness(0.1, plugin)
    node.send("ask", *[node._runtime.handle.make_packet("at") for _ in range(2)])
    send(node, *steps(16))
    assert ticks(node) == [0.1, 0.2]  # at 0.3 it waits for its other input
    assert node.node.sim_time == 0.28


def test_with_packets_of_its_clock_waiting_a_tick_passes_over_those_between_its_times(harness):
    node = harness(0.1, discard_limit=0, queue_size=8)
    node.block("at")
    send(node, 0.1, 0.2, 0.22, 0.24, 0.3, 0.32)
    node.unblock("at")
    node.run()
    assert ticks(node) == [0.1, 0.2, 0.3]


def test_a_tick_that_leaves_out_its_clock_has_its_other_inputs(harness):
    plugin = """
from neuros.hooks import neuros_tick
from std_msgs.msg import Float64

@neuros_tick(sim_seconds={period}, inputs="ask", outputs="at")
def tick(node, ask):
    return Float64(data=node.sim_time + ask.data)
"""
    node = harness(0.1, plugin)
    node.send("ask", Float64(data=5.0))
    send(node, 0.1)
    assert ticks(node) == [5.1]


def test_a_clock_that_no_hook_takes_is_known_nevertheless(harness):
    plugin = PLUGIN[: PLUGIN.index("@neuros_tick")] + PLUGIN[PLUGIN.index("@neuros_function") :]
    node = harness(plugin=plugin)
    assert node.node.sim_time is None
    assert to_seconds(node.node.now()) == 0.0
    send(node, 0.25)
    assert node.node.sim_time == to_seconds(node.node.now()) == 0.25
    assert not [
        record for record in node.log if "no hook takes" in record.text and "clock" in record.text
    ]


def test_without_a_clock_now_is_wall_time(harness):
    plugin = PLUGIN[: PLUGIN.index("@neuros_tick")] + PLUGIN[PLUGIN.index("@neuros_function") :]
    node = harness(plugin=plugin, inputs=())
    assert node.node.sim_time is None
    assert to_seconds(node.node.now()) > 1.7e9


@pytest.mark.parametrize(
    ("inputs", "text"),
    [
        ((), "node 'node' has no input of type rosgraph_msgs/msg/Clock: give it one"),
        (("one", "two"), "has several inputs of type rosgraph_msgs/msg/Clock: name the one"),
    ],
)
def test_a_tick_without_a_clock_is_refused(harness, inputs, text):
    with pytest.raises(HookError, match=text):
        harness(inputs=inputs)


@pytest.mark.parametrize("port", ['Optional("clock")', 'All("clock")'])
def test_a_tick_needs_a_single_packet_of_its_clock(harness, port):
    plugin = f"""
from neuros.hooks import All, Optional, neuros_tick
@neuros_tick(sim_seconds={{period}}, inputs={port})
def tick(node, clock): pass
"""
    with pytest.raises(HookError, match="take that input without All and Optional"):
        harness(plugin=plugin)


@given(st.sampled_from([1 / 60, 1 / 3, 0.1, 0.02, 1 / 240, 0.7]), st.integers(1, 10**10))
def test_stamps_that_are_rounded_to_nanoseconds_are_on_time(period_s, number):
    """1 / 60 s is no whole number of nanoseconds; a stamp of it is early by up to half a one."""
    periods = Periods(period_s)
    at_ns = round(number * periods._period_ns)
    assert not periods.is_due(at_ns - 1)
    assert periods.is_due(at_ns)
    assert periods.tick(at_ns) == 0
    assert not periods.is_due(at_ns + 1)


@given(st.lists(st.integers(0, 10**9), min_size=1).map(sorted))
def test_every_period_is_a_tick_or_is_counted(times_ns):
    periods, ran, missed = Periods(0.05), 0, 0
    for time_ns in [0, *times_ns]:
        if periods.is_due(time_ns):
            ran += 1
            missed += periods.tick(time_ns)
    assert ran + missed == times_ns[-1] // 50_000_000
