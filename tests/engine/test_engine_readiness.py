"""When a hook runs: input, output and timer condition, registration, initialisation first."""

from __future__ import annotations

from pathlib import Path

import pytest
from engine_bench import Bench, Clock, finalise, function, initialise, tick, wire

from neuros.engine.engine import Engine
from neuros.errors import HookError
from neuros.hooks import All, Optional
from neuros.project.model import Node, Port

A, B = "a.o -> node.x", "b.o -> node.x"


# ------------------------------------------------------------------ input condition


def test_a_hook_waits_for_every_input_that_is_not_optional():
    bench = Bench(
        function("f", ["x", "y"]), connections=[wire("a.o -> node.x"), wire("a.p -> node.y")]
    )
    assert bench.packet("a.o -> node.x", 1) == []
    assert bench.packet("a.p -> node.y", 2) == ["f"]
    assert bench.calls == [("f", (1, 2))]


def test_a_plain_input_takes_a_packet_of_any_one_connection():
    bench = Bench(function("f", "x"), connections=[wire(A), wire(B)])
    assert bench.packet(B, "from b") == ["f"]
    assert bench.calls == [("f", ("from b",))]


def test_an_all_input_waits_for_one_packet_of_every_connection():
    bench = Bench(function("f", All("x")), connections=[wire(A), wire(B)])
    assert bench.packet(B, "from b") == []
    assert bench.packet(A, "from a") == ["f"]


def test_an_all_input_is_a_list_in_the_order_of_the_project_file():
    bench = Bench(function("f", All("x")), connections=[wire(B), wire(A)])
    bench.packet(A, "from a")
    bench.packet(B, "from b")
    assert bench.calls == [("f", (["from b", "from a"],))]


def test_an_all_input_tells_two_outputs_of_one_node_apart():
    bench = Bench(
        function("f", All("x")), connections=[wire("a.o -> node.x"), wire("a.p -> node.x")]
    )
    bench.packet("a.p -> node.x", "p")
    bench.packet("a.o -> node.x", "o")
    assert bench.calls == [("f", (["o", "p"],))]


def test_an_optional_input_may_be_missing():
    bench = Bench(
        function("f", ["x", Optional("y")]),
        connections=[wire(A), wire("b.o -> node.y")],
    )
    bench.packet(A, 1)
    assert bench.calls == [("f", (1, None))]


def test_an_optional_input_is_taken_if_it_is_there():
    bench = Bench(
        function("f", ["x", Optional("y")]),
        connections=[wire(A), wire("b.o -> node.y")],
    )
    assert bench.packet("b.o -> node.y", 2) == []
    bench.packet(A, 1)
    assert bench.calls == [("f", (1, 2))]


def test_optional_all_has_none_for_each_connection_that_has_nothing_yet():
    bench = Bench(
        function("f", ["go", Optional(All("x"))]),
        connections=[wire(A), wire(B), wire("c.o -> node.go")],
    )
    bench.packet(B, "from b")
    bench.packet("c.o -> node.go", "go")
    bench.packet("c.o -> node.go", "go")
    assert bench.calls == [("f", ("go", [None, "from b"])), ("f", ("go", [None, None]))]


def test_an_optional_input_need_not_be_connected():
    bench = Bench(function("f", [Optional("x"), Optional(All("y"))]))
    assert bench.calls == [("f", (None, []))]


@pytest.mark.parametrize("port", ["x", All("x")])
def test_a_required_input_without_any_source_is_an_error_at_start(port):
    with pytest.raises(HookError, match=r"engine_bench\.py:\d+: hook 'f': needs input 'x'"):
        Bench(function("f", port))


def test_an_external_topic_is_a_source_of_an_input():
    bench = Bench(function("f", "x"), external_inputs=["x"])
    assert bench.packet("x", 1) == ["f"]


# ------------------------------------------------------------------ output condition


def test_a_hook_does_not_run_while_a_connection_of_one_of_its_outputs_is_blocked():
    bench = Bench(
        function("f", "x", ["o", "p"], returns=(1, 2)),
        connections=[wire(A), wire("node.o -> b.x", 0), wire("node.p -> b.y")],
    )
    assert bench.packet(A) == ["f"]
    assert bench.packet(A) == []
    assert bench.acknowledge_to_node("node.o -> b.x", 1) == ["f"]


def test_optional_outputs_hold_a_hook_up_too():
    bench = Bench(
        function("f", "x", Optional("o"), returns=1),
        connections=[wire(A), wire("node.o -> b.x", 0)],
    )
    bench.packet(A)
    assert bench.packet(A) == []


def test_a_blocked_output_holds_up_only_the_hooks_that_declare_it():
    bench = Bench(
        function("f", "x", "o", returns=1),
        function("g", "x"),
        connections=[wire(A), wire("node.o -> b.x", 0)],
    )
    bench.packet(A)
    assert bench.packet(A) == ["g"]


def test_one_blocked_receiver_of_several_is_enough():
    bench = Bench(
        function("f", "x", "o", returns=1),
        connections=[wire(A), wire("node.o -> b.x", 0), wire("node.o -> c.x", 0)],
    )
    bench.packet(A)
    bench.acknowledge_to_node("node.o -> b.x", 1)
    assert bench.packet(A) == []
    assert bench.acknowledge_to_node("node.o -> c.x", 1) == ["f"]


def test_a_hook_that_cannot_start_keeps_its_packets_and_their_senders_block():
    bench = Bench(
        function("f", "x", "o", returns=1),
        connections=[wire(A, 0), wire("node.o -> b.x", 0)],
    )
    bench.packet(A, 1)
    bench.packet(A, 2)
    assert bench.acknowledged == [(A, 1)]
    bench.acknowledge_to_node("node.o -> b.x", 1)
    assert bench.acknowledged == [(A, 1), (A, 2)]


# ------------------------------------------------------------------ registration


def test_no_hook_runs_before_every_connection_of_every_output_is_registered():
    bench = Bench(
        initialise("init"),
        function("f", "x"),
        tick("t", 1.0),
        connections=[wire(A), wire("node.o -> b.x"), wire("node.p -> b.x")],
        is_registered=False,
    )
    bench.packet(A)
    bench.pass_time(5.0)
    bench.register("node.o -> b.x")
    assert bench.ran == []
    assert bench.register("node.p -> b.x") == ["init", "f"]


def test_a_repeated_registration_does_no_harm():
    bench = Bench(
        function("f"),
        connections=[wire("node.o -> b.x"), wire("node.p -> b.x")],
        is_registered=False,
    )
    bench.register("node.o -> b.x")
    assert bench.register("node.o -> b.x") == []
    assert bench.register("node.p -> b.x") == ["f"]


def test_inputs_need_no_registration():
    assert Bench(function("f", Optional("x")), connections=[wire(A)]).ran == ["f"]


def test_no_hook_runs_before_the_start():
    bench = Bench(function("f"), is_started=False)
    assert bench.ran == []
    bench.engine.start()
    assert bench.ran == ["f"]


def test_a_connection_to_itself_is_there_as_soon_as_the_node_is():
    connection = wire("node.o -> node.x", 0)
    bench = Bench(
        function("f", Optional("x"), "o", returns=1), connections=[connection], is_registered=False
    )
    assert bench.ran == ["f"]


def test_packets_that_arrive_before_the_start_are_kept():
    bench = Bench(function("f", "x"), connections=[wire(A, 0)], is_started=False)
    bench.packet(A, 1)
    bench.engine.start()
    assert bench.calls == [("f", (1,))]


# ------------------------------------------------------------------ initialisation first


def test_initialise_hooks_run_once_and_before_all_others():
    bench = Bench(function("f"), initialise("init"))
    bench.settle(3)
    assert bench.ran == ["init", "f", "f", "f"]


def test_nothing_else_runs_before_every_initialise_hook_has_run():
    bench = Bench(function("f"), initialise("one"), initialise("two", "x"), connections=[wire(A)])
    assert bench.ran == ["one"]
    assert bench.packet(A) == ["two"]
    assert bench.settle(1) == ["f"]


def test_a_hook_is_ready_where_its_own_start_frees_its_output():
    own = "node.o -> node.x"
    bench = Bench(
        initialise("first", outputs="o", returns="ball"),
        function("f", "x", "o", "ball"),
        connections=[wire(own, 0)],
    )
    bench.engine.pause()
    bench.posted_event()  # the first packet arrives
    assert bench.hook("f").blocked
    assert bench.hook("f").is_ready()


def test_an_initialise_hook_waits_for_its_receivers_and_sends_to_them():
    bench = Bench(
        initialise("init", outputs="o", returns="ball"),
        connections=[wire("node.o -> b.x", 0)],
        is_registered=False,
    )
    assert bench.register("node.o -> b.x") == ["init"]
    assert bench.sent == [("node.o -> b.x", "ball")]


def test_once_run_initialise_hooks_no_longer_count_as_takers_of_their_inputs():
    bench = Bench(
        initialise("init", "x"),
        function("f", "x"),
        connections=[wire(A, 0, queue_size=2)],
    )
    bench.packet(A, 1)
    assert bench.calls == [("init", (1,)), ("f", (1,))]
    bench.packet(A, 2)
    bench.packet(A, 3)
    assert bench.acknowledged == [(A, 1), (A, 2), (A, 3)]


def test_an_input_that_only_initialise_hooks_took_is_acknowledged_on_arrival_from_then_on():
    bench = Bench(initialise("init", "x"), connections=[wire(A, 0, queue_size=3)])
    assert bench.packet(A, 1) == ["init"]
    bench.packet(A, 2)
    assert bench.acknowledged == [(A, 1), (A, 2)]


def test_what_an_initialise_hook_had_not_taken_is_acknowledged_when_it_goes():
    bench = Bench(
        initialise("init", ["x", "y"]),
        connections=[wire(A, 0, queue_size=3), wire("b.o -> node.y")],
    )
    bench.packet(A, 1)
    bench.packet(A, 2)
    bench.packet("b.o -> node.y")
    assert bench.acknowledged == [(A, 1), (A, 2)]


def test_finalise_hooks_are_not_the_engines_business():
    bench = Bench(finalise("end"), function("f", "x"), connections=[wire(A)])
    bench.packet(A)
    assert bench.ran == ["f"]


# ------------------------------------------------------------------ undeclared ports


@pytest.mark.parametrize("side", ["input", "output"])
def test_a_port_that_the_node_does_not_declare_is_an_error_that_says_what_there_is(side):
    port = Port("known", "std_msgs/msg/String")
    node = Node("node", "c", Path("p.py"), inputs=(port,), outputs=(port,))
    spec = function("f", **{f"{side}s": "unknown"})
    with pytest.raises(HookError) as caught:
        Engine(node, [wire("a.o -> node.known")], [spec], Bench(), Clock())
    assert caught.value.hook == "f"
    assert caught.value.where == spec.where
    assert f"declares no {side} 'unknown' (it has known)" in str(caught.value)
