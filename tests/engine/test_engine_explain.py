"""The stall explainer: who waits for whom, and why."""

from __future__ import annotations

from engine_bench import Bench, function, initialise, tick, wire

from neuros.engine.snapshot import explain
from neuros.hooks import All, Optional

IN, OUT = "robot.imu -> node.imu", "node.o -> visualiser.o"


def reasons(bench: Bench) -> list[str]:
    return explain(bench.engine, bench.clock())


def test_a_missing_input_names_its_sender():
    bench = Bench(function("f", "imu"), connections=[wire(IN)])
    assert reasons(bench) == ["waits for `imu` from robot"]


def test_a_plain_input_waits_for_any_of_its_senders():
    bench = Bench(function("f", "x"), connections=[wire("a.o -> node.x"), wire("b.o -> node.x")])
    assert reasons(bench) == ["waits for `x` from a or b"]


def test_an_all_input_waits_for_those_that_have_not_sent():
    names = ("a", "b", "c")
    bench = Bench(function("f", All("x")), connections=[wire(f"{n}.o -> node.x") for n in names])
    bench.packet("b.o -> node.x")
    assert reasons(bench) == ["waits for `x` from a and c"]


def test_an_external_topic_is_named():
    bench = Bench(function("f", "x"), external_inputs=["x"])
    assert reasons(bench) == ["waits for `x` from topic /x"]


def test_optional_inputs_are_no_reason():
    bench = Bench(
        function("f", ["imu", Optional("y")]), connections=[wire(IN), wire("a.o -> node.y")]
    )
    assert reasons(bench) == ["waits for `imu` from robot"]


def test_a_blocked_connection_says_how_many_are_outstanding_and_since_when():
    bench = Bench(function("f", outputs="o", returns=1), connections=[wire(OUT, 0)])
    assert reasons(bench) == [f"is blocked on `{OUT}` (1 outstanding, none acknowledged yet)"]
    bench.acknowledge_to_node(OUT, 1)
    bench.clock.advance(2.1)
    assert reasons(bench) == [f"is blocked on `{OUT}` (1 outstanding, last acknowledged 2.1 s ago)"]


def test_its_own_packet_that_a_hook_would_take_is_no_reason():
    bench = Bench(
        function("f", Optional("x"), "o", returns=1),
        connections=[wire("node.o -> node.x", 0), wire(OUT, 0)],
    )
    bench.settle()
    assert reasons(bench) == [f"is blocked on `{OUT}` (1 outstanding, none acknowledged yet)"]


def test_a_running_hook_is_the_only_reason():
    bench = Bench(
        function("f", "imu"), function("g", "x"), connections=[wire(IN), wire("a.o -> node.x")]
    )
    seen = []
    bench.hook_s = 7.2
    bench.during_call = lambda: seen.append(reasons(bench))
    bench.packet(IN)
    assert seen == [["executes hook 'f' for 7.2 s"]]


def test_a_tick_hook_says_when_it_is_due():
    bench = Bench(tick("y", 1.0))
    bench.clock.advance(0.7)
    assert reasons(bench) == ["waits for the next tick of 'y' in 0.3 s"]
    bench.clock.advance(0.7)
    assert reasons(bench) == ["waits for the next tick of 'y' in 0.0 s"]


def test_receivers_that_have_not_appeared_are_named():
    bench = Bench(
        function("f", "imu", "o"),
        connections=[wire(IN), wire(OUT), wire("node.o -> b.x"), wire("node.o -> node.x")],
        is_registered=False,
    )
    bench.register(OUT)
    assert reasons(bench) == ["waits for these receivers to appear: node.o -> b.x"]


def test_one_sentence_per_reason_each_said_once():
    bench = Bench(
        function("f", ["imu", "x"]),
        function("g", "imu", "o", returns=1),
        function("free", outputs="o", returns=1),
        connections=[wire(IN), wire("a.o -> node.x"), wire(OUT, 0)],
    )
    assert reasons(bench) == [
        "waits for `imu` from robot",
        "waits for `x` from a",
        f"is blocked on `{OUT}` (1 outstanding, none acknowledged yet)",
    ]


def test_while_an_initialise_hook_waits_only_that_is_a_reason():
    bench = Bench(
        function("f", "x"), initialise("init", "imu"), connections=[wire(IN), wire("a.o -> node.x")]
    )
    assert reasons(bench) == ["waits for `imu` from robot"]


def test_a_simulator_that_sends_by_itself():
    bench = Bench(connections=[wire(OUT, 0)])
    bench.engine.offer({"o": 1}, lambda: None)
    assert reasons(bench) == ["waits for its simulator to send `o`"]
    bench.engine.offer({"o": 2}, lambda: None)
    assert reasons(bench) == [f"is blocked on `{OUT}` (1 outstanding, none acknowledged yet)"]


def test_other_states_have_a_sentence_too():
    assert reasons(Bench(function("f"))) == ["is about to run hook 'f'"]
    assert reasons(Bench(is_started=False)) == ["has not been started yet"]
    assert reasons(Bench()) == ["has no hook that could run any more"]
    bench = Bench(function("f", "imu"), connections=[wire(IN)])
    bench.engine.stop_hooks()
    assert reasons(bench) == ["starts no further hook, since it is ending"]
