"""Ending: stopped, drained, and deadlock: what could still run, and what could wake a node."""

from __future__ import annotations

import pytest
from engine_bench import Bench, function, initialise, tick, wire

from neuros.hooks import All, Optional

IN, OUT, OWN = "a.o -> node.x", "node.o -> b.x", "node.o -> node.x"


# ------------------------------------------------------------------ stopped


def test_what_the_hook_returns_that_ends_the_project_is_still_sent():
    bench = Bench(function("f", "x", "o", returns="last"), connections=[wire(IN), wire(OUT, 0)])
    bench.during_call = bench.engine.stop_hooks
    bench.packet(IN)
    assert bench.sent == [(OUT, "last")]


def test_then_the_node_starts_no_further_hook():
    bench = Bench(function("f", "x"), function("g", "x"), function("free"), connections=[wire(IN)])
    bench.settle(1)
    bench.during_call = bench.engine.stop_hooks
    assert bench.packet(IN) == ["f"]
    assert bench.settle() == []
    assert bench.packet(IN) == []
    assert not bench.engine.has_ready_hook
    assert not bench.engine.has_startable_packet
    assert not bench.engine.is_wakeable


def test_an_initialise_hook_may_end_the_project():
    bench = Bench(initialise("init"), function("f"), is_started=False)
    bench.during_call = bench.engine.stop_hooks
    bench.engine.start()
    assert bench.settle() == []
    assert bench.ran == ["init"]


# ------------------------------------------------------------------ drained


def test_draining_stops_tick_hooks_and_hooks_that_send_unasked():
    bench = Bench(
        function("free", outputs="o", returns=1),
        function("lazy", Optional("x"), "o", returns=1),
        tick("t", 1.0),
        tick("asked", 1.0, "x"),
        connections=[wire(IN), wire(OUT)],
    )
    bench.engine.drain()
    before = len(bench.calls)
    bench.settle()
    bench.pass_time(5.0)
    bench.packet(IN)
    assert bench.ran[before:] == []
    assert bench.engine.next_due_ns is None


def test_a_tick_that_was_due_does_not_run_any_more():
    bench = Bench(tick("t", 1.0, outputs="o", returns=1), connections=[wire(OUT, 0)])
    bench.pass_time(1.0)
    bench.pass_time(1.0)
    bench.engine.drain()
    assert bench.acknowledge_to_node(OUT, 1) == []


def test_other_hooks_go_on():
    bench = Bench(
        function("f", ["x", Optional("y")], "o", returns=1),
        function("g", Optional("x")),
        connections=[wire(IN), wire("c.o -> node.y"), wire(OUT)],
    )
    bench.engine.drain()
    bench.packet(IN)
    assert bench.sent == [(OUT, 1)]
    assert "g" in bench.ran


def test_an_initialise_hook_that_does_not_send_unasked_goes_on_and_so_what_waits_for_it():
    bench = Bench(initialise("init", "x"), function("f", "x"), connections=[wire(IN, 0)])
    bench.engine.drain()
    assert bench.packet(IN) == ["init", "f"]


def test_an_initialise_hook_that_sends_unasked_does_not():
    bench = Bench(
        initialise("init", outputs="o", returns=1),
        function("f", "x"),
        connections=[wire(IN, 0), wire(OUT)],
        is_registered=False,
    )
    bench.engine.drain()
    bench.register(OUT)
    assert bench.packet(IN) == []
    assert not bench.engine.has_startable_packet


@pytest.mark.parametrize("is_before_initialisation", [True, False])
def test_draining_holds_whenever_it_comes(is_before_initialisation):
    bench = Bench(
        initialise("init", "x"),
        function("free", outputs="o", returns=1),
        tick("t", 1.0),
        connections=[wire(IN), wire(OUT)],
    )
    if is_before_initialisation:
        bench.engine.drain()
    bench.packet(IN)
    if not is_before_initialisation:
        bench.engine.drain()
    before = len(bench.calls)
    bench.settle(5)
    bench.pass_time(3.0)
    assert bench.ran[before:] == []


def test_a_hook_of_the_last_round_starts_once_more_and_keeps_what_comes_after():
    bench = Bench(function("f", "x", "o", returns=1), connections=[wire(IN, 0), wire(OUT)])
    bench.packet(IN)
    bench.engine.drain(last_round=[0])
    assert bench.packet(IN) == ["f"]
    assert bench.packet(IN) == []
    (subscription,) = bench.engine.subscriptions.values()
    assert (subscription.received, subscription.consumed, subscription.unread) == (3, 2, 1)
    assert not bench.engine.has_startable_packet
    assert not bench.engine.has_ready_hook


def test_so_does_one_that_was_initialised_only_then():
    bench = Bench(
        function("f", "x"), initialise("init"), connections=[wire(IN, 0, 2)], is_started=False
    )
    bench.engine.drain(last_round=[0])
    bench.engine.start()
    bench.packet(IN)
    assert bench.packet(IN) == []
    assert bench.ran == ["init", "f"]


def test_drained_means_that_no_hook_could_start_on_a_packet():
    bench = Bench(
        function("f", ["x", "y"]),
        function("loop"),
        connections=[wire(IN, 0), wire("b.o -> node.y", 0)],
    )
    bench.packet(IN)
    assert bench.engine.has_ready_hook
    assert not bench.engine.has_startable_packet  # f lacks y; the loop takes no packet


def test_a_packet_whose_hook_is_ready_is_startable():
    bench = Bench(function("f", "x"), connections=[wire(IN, 0, queue_size=2)], is_started=False)
    bench.packet(IN)
    assert not bench.engine.has_startable_packet
    bench.packet(IN)
    bench.engine.start()
    assert bench.engine.has_startable_packet
    bench.settle()
    assert not bench.engine.has_startable_packet


def test_a_packet_behind_a_blocked_output_is_not_startable():
    bench = Bench(function("f", "x", "o", returns=1), connections=[wire(IN, 0), wire(OUT, 0)])
    bench.packet(IN)
    bench.packet(IN)
    assert not bench.engine.has_startable_packet


# ------------------------------------------------------------------ wakeable


def is_wakeable(*specs, connections=(), **options) -> bool:
    bench = Bench(*specs, connections=connections, **options)
    bench.settle(10)
    return bench.engine.is_wakeable


def test_a_node_that_waits_for_another_node_cannot_wake_itself():
    assert not is_wakeable(function("f", "x"), connections=[wire(IN)])


def test_nor_one_that_waits_for_an_acknowledgement():
    assert not is_wakeable(function("f", outputs="o", returns=1), connections=[wire(OUT, 0)])


def test_a_ready_hook_is_awake():
    assert is_wakeable(function("f"))


def test_a_timer_wakes_a_tick_hook():
    assert is_wakeable(tick("t", 1.0))


@pytest.mark.parametrize("connection", [wire(IN), wire(OUT, 0)], ids=["input", "output"])
def test_but_not_one_that_also_lacks_a_packet_or_a_receiver(connection):
    bench = Bench(
        tick("t", 1.0, "x" if connection.destination_node == "node" else None, "o", returns=1),
        connections=[connection],
    )
    bench.pass_time(1.0)
    assert not bench.engine.is_wakeable


def test_a_tick_hook_that_its_own_packet_blocks_and_would_take_it_is_wakeable():
    bench = Bench(tick("t", 1.0, Optional("x"), "o", returns=1), connections=[wire(OWN, 0)])
    bench.pass_time(1.0)
    bench.settle()
    assert bench.engine.is_wakeable


def test_an_external_topic_wakes_a_hook():
    assert is_wakeable(function("f", "x"), external_inputs=["x"])


def test_and_a_tick_hook_that_is_not_due_yet():
    assert is_wakeable(tick("t", 1.0, "x"), external_inputs=["x"])


def test_but_not_a_hook_that_lacks_something_else_too():
    assert not is_wakeable(
        function("f", ["x", "y"]), connections=[wire("a.o -> node.y")], external_inputs=["x"]
    )
    assert not is_wakeable(
        function("f", "x", "o", returns=1),
        initialise("init", outputs="o", returns=1),
        connections=[wire(OUT, 0)],
        external_inputs=["x"],
    )


def test_an_all_input_lacks_a_packet_of_every_connection():
    bench = Bench(function("f", All("x")), connections=[wire(IN)])
    assert not bench.engine.is_wakeable


def test_what_wakes_a_function_hook_does_not_help_while_an_initialise_hook_waits():
    assert not is_wakeable(
        initialise("init", "x"),
        function("f", "y"),
        tick("t", 1.0),
        connections=[wire(IN)],
        external_inputs=["y"],
    )


def test_a_node_whose_receivers_have_still_to_appear_may_wake():
    assert is_wakeable(function("f", "x"), connections=[wire(IN), wire(OUT)], is_registered=False)


# ------------------------------------------------------------------ a loop that stalls


def test_step_and_control_with_limit_0_both_ways_stall_by_themselves():
    """The loop of the specification, seen from ``step``; ``control`` answers each packet."""
    command, sensors = "control.command -> node.command", "node.sensors -> control.sensors"
    bench = Bench(
        function("step", Optional("command"), "sensors", returns="sensors"),
        connections=[wire(command, 0), wire(sensors, 0)],
    )
    bench.acknowledge_to_node(sensors, 1)  # control has started on the first packet; step again
    assert bench.packet(command) == []  # control's answer: step is blocked, and so keeps it
    # control cannot start on the second packet, since its own answer is outstanding.
    assert not bench.engine.is_wakeable
    assert bench.acknowledged == []


def test_taking_the_returning_input_in_a_hook_of_its_own_cures_it():
    command, sensors = "control.command -> node.command", "node.sensors -> control.sensors"
    bench = Bench(
        function("step", outputs="sensors", returns="sensors"),
        function("take", "command"),
        connections=[wire(command, 0), wire(sensors, 0)],
    )
    bench.acknowledge_to_node(sensors, 1)
    assert bench.packet(command) == ["take"]
    assert bench.acknowledged == [(command, 1)]
