"""Priority, the loop-back, and what a starting hook takes."""

from __future__ import annotations

from engine_bench import Bench, function, tick, wire

from neuros.hooks import All, Optional

A, B = "a.o -> node.x", "b.o -> node.x"


def test_before_any_execution_the_order_is_that_of_declaration():
    assert Bench(function("c"), function("a"), function("b")).ran == ["c", "a", "b"]


def test_least_recently_executed_comes_first():
    bench = Bench(
        function("f", "x"),
        function("g", "y"),
        function("h", ["x", "y"]),
        connections=[wire(A), wire("b.o -> node.y")],
    )
    assert bench.packet(A) == ["f"]
    assert bench.packet("b.o -> node.y") == ["g", "h"]
    bench.packet(A)
    bench.packet("b.o -> node.y")
    assert bench.ran == ["f", "g", "h", "f", "g", "h"]


def test_a_hook_that_has_not_run_for_longer_goes_before_one_declared_earlier():
    bench = Bench(
        function("f", Optional("x"), "o", returns=1),
        function("g", outputs="o", returns=2),
        connections=[wire("node.o -> b.x", 0)],
    )
    assert bench.ran == ["f"]
    for position in (1, 2, 3):
        bench.acknowledge_to_node("node.o -> b.x", position)
    assert bench.ran == ["f", "g", "f", "g"]


def test_readiness_is_asked_at_a_hooks_turn():
    """The first hook of the pass blocks the second, which was ready at its start."""
    bench = Bench(
        function("f", "x", "o", returns=1),
        function("g", "x", "o", returns=2),
        connections=[wire(A), wire("node.o -> b.x", 0)],
    )
    assert bench.packet(A) == ["f"]
    assert bench.acknowledge_to_node("node.o -> b.x", 1) == ["g"]


def test_a_hook_runs_at_most_once_per_event():
    bench = Bench(function("f", "x"), connections=[wire(A, queue_size=3)], is_started=False)
    for number in range(3):
        bench.packet(A, number)
    bench.engine.start()
    assert bench.calls == [("f", (0,))]
    assert bench.settle() == ["f", "f"]


def test_if_some_hook_is_still_ready_the_node_posts_itself_one_loop_back():
    bench = Bench(function("f"), function("g"))
    assert bench.waiting == ["loop-back"]
    bench.engine.on_timer()
    assert bench.waiting == ["loop-back"]


def test_if_no_hook_is_ready_there_is_no_loop_back():
    bench = Bench(function("f", "x"), connections=[wire(A)])
    bench.packet(A)
    assert bench.waiting == []


def test_incoming_packets_are_seen_between_two_rounds_of_a_main_loop():
    """A loop-back is handled after every event that waits already; here a packet."""
    bench = Bench(function("loop"), function("f", "x"), connections=[wire(A)])
    assert bench.ran == ["loop"]
    assert bench.packet(A) == ["f", "loop"]
    assert bench.waiting == ["loop-back"]


def test_a_hook_with_only_optional_inputs_or_none_runs_without_pause():
    bench = Bench(function("f"), function("g", Optional("x")), connections=[wire(A)])
    assert bench.settle(3) == ["f", "g"] * 3
    assert [hook.name for hook in bench.engine.free_running_hooks()] == ["f", "g"]


def test_such_a_hook_sleeps_while_its_outputs_are_blocked():
    bench = Bench(function("f", outputs="o", returns=1), connections=[wire("node.o -> b.x", 0)])
    assert bench.ran == ["f"]
    assert bench.waiting == []
    bench.acknowledge_to_node("node.o -> b.x", 1)
    assert bench.ran == ["f", "f"]


def test_ticks_and_hooks_with_required_inputs_are_no_main_loops():
    bench = Bench(
        tick("t", 1.0),
        function("f", "x"),
        function("g", ["x", Optional("y")]),
        connections=[wire(A)],
    )
    assert bench.engine.free_running_hooks() == []


def test_hooks_never_nest_even_if_one_of_them_has_events_handled():
    """A plugin may spin its ROS node inside a hook; a node is single-threaded all the same."""
    bench = Bench(
        function("f", "x"), function("g", "y"), connections=[wire(A), wire("b.o -> node.y")]
    )
    bench.during_call = lambda: bench.engine.on_packet(bench.by_name["b.o -> node.y"], 2)
    bench.packet(A, 1)
    bench.during_call = None
    assert bench.log[:4] == [("start", "f"), ("end", "f"), ("start", "g"), ("end", "g")]


def test_what_comes_in_while_the_last_hook_of_a_pass_runs_is_for_the_loop_back():
    bench = Bench(function("f", "x"), connections=[wire(A)])
    bench.during_call = lambda: bench.engine.on_packet(bench.by_name[A], 2)
    bench.packet(A, 1)
    bench.during_call = None
    assert bench.calls == [("f", (1,))]
    assert bench.settle() == ["f"]
    assert bench.engine.spent_ns.total() >= 0


# ------------------------------------------------------------------ consumption


def test_a_starting_hook_takes_the_oldest_packet_of_each_of_its_inputs():
    bench = Bench(
        function("f", ["x", "y"]),
        connections=[wire(A, 0, queue_size=3), wire("b.o -> node.y", 0, queue_size=3)],
    )
    for number in (1, 2):
        bench.packet(A, number)
    for number in (10, 20):
        bench.packet("b.o -> node.y", number)
    assert bench.calls == [("f", (1, 10)), ("f", (2, 20))]


def test_a_plain_input_takes_from_the_connection_whose_oldest_packet_has_waited_longest():
    bench = Bench(
        function("f", ["go", "x"]),
        connections=[wire(A, 0, 3), wire(B, 0, 3), wire("c.o -> node.go", 0, 9)],
    )
    for connection, packet in ((B, "b1"), (A, "a1"), (A, "a2"), (B, "b2")):
        bench.packet(connection, packet)
    for _ in range(4):
        bench.packet("c.o -> node.go", "go")
    assert [inputs[1] for _, inputs in bench.calls] == ["b1", "a1", "a2", "b2"]


def test_a_discard_makes_the_next_packet_of_the_connection_the_oldest():
    bench = Bench(
        function("f", ["go", "x"]), connections=[wire(A), wire(B), wire("c.o -> node.go")]
    )
    for connection, packet in ((A, "a1"), (B, "b1"), (A, "a2")):  # a2 replaces a1
        bench.packet(connection, packet)
    bench.packet("c.o -> node.go", "go")
    assert bench.calls == [("f", ("go", "b1"))]


def test_two_hooks_with_the_same_input_both_get_every_packet():
    bench = Bench(
        function("f", "x"),
        function("g", ["x", "go"]),
        connections=[wire(A, 0, 5), wire("c.o -> node.go", 0, 5)],
    )
    for number in range(3):
        bench.packet(A, number)
    for _ in range(3):
        bench.packet("c.o -> node.go", "go")
    assert [inputs[0] for name, inputs in bench.calls if name == "f"] == [0, 1, 2]
    assert [inputs[0] for name, inputs in bench.calls if name == "g"] == [0, 1, 2]


def test_they_share_the_object():
    bench = Bench(function("f", "x"), function("g", "x"), connections=[wire(A)])
    packet = object()
    bench.packet(A, packet)
    assert bench.calls[0][1][0] is bench.calls[1][1][0] is packet


def test_one_hook_may_take_the_same_input_plainly_and_another_all_of_it():
    bench = Bench(function("f", "x"), function("g", All("x")), connections=[wire(A), wire(B)])
    assert bench.packet(A, 1) == ["f"]
    assert bench.packet(B, 2) == ["g", "f"]
    assert ("g", ([1, 2],)) in bench.calls


def test_the_external_topic_of_an_all_input_is_last_in_the_list():
    """It cannot occur in ``connections``, so it is the only one."""
    bench = Bench(function("f", All("x")), external_inputs=["x"])
    bench.packet("x", 1)
    assert bench.calls == [("f", ([1],))]


# ------------------------------------------------------------------ arrivals first


def after_a_hook_something_may_have_arrived(bench: Bench) -> None:
    """As a node with neighbours has it: a loop-back comes when that has been handled."""

    def ran() -> None:
        bench.is_taken_in = False

    bench.during_call = ran


def test_where_something_may_have_arrived_the_next_hook_is_chosen_after_that():
    bench = Bench(function("f"), function("g"), is_started=False)
    after_a_hook_something_may_have_arrived(bench)
    bench.engine.start()
    assert bench.ran == ["f"]
    assert bench.waiting == ["loop-back"]
    bench.is_taken_in = True
    assert bench.posted_event() == ["g"]


def test_what_arrives_meanwhile_starts_no_hook_but_is_there_for_the_next():
    bench = Bench(
        function("look", "x"), function("obey", "y"), connections=[wire(A), wire("b.o -> node.y")]
    )
    after_a_hook_something_may_have_arrived(bench)
    assert bench.packet(A, 1) == ["look"]
    assert bench.packet(A, 2) == bench.packet(A, 3) == bench.packet("b.o -> node.y", 1) == []
    assert bench.waiting == ["loop-back"]
    bench.is_taken_in = True
    assert bench.posted_event() == ["obey"]
    bench.is_taken_in = True
    assert bench.posted_event() == ["look"]
    assert bench.calls[-1] == ("look", (3,))


def test_a_loop_back_from_before_the_last_execution_starts_nothing_ahead_of_arrivals():
    bench = Bench(function("slow", "x"), function("quick", "x"), connections=[wire(A)])
    after_a_hook_something_may_have_arrived(bench)
    assert bench.packet(A, 1) == ["slow"]
    bench.is_taken_in = True
    assert bench.packet(A, 2) == ["quick"]  # the loop-back of the first one still waits
    assert bench.posted_event() == []
    assert bench.packet(A, 3) == []
    bench.is_taken_in = True
    assert bench.posted_event() == ["slow"]
    assert bench.calls[-1] == ("slow", (3,))


def test_acknowledgements_that_have_piled_up_start_a_main_loop_once():
    """Else it would run once more for each, and what its input gets would grow older and older."""
    receivers = [wire(f"node.o -> {name}.x", 0, queue_size=8) for name in ("b", "c", "d")]
    bench = Bench(
        function("step", Optional("x"), "o", returns=1), connections=[wire(A), *receivers]
    )
    after_a_hook_something_may_have_arrived(bench)
    bench.is_taken_in = False
    for receiver in receivers:
        assert bench.acknowledge_to_node(str(receiver), 1) == []
    bench.is_taken_in = True
    assert bench.posted_event() == ["step"]


def test_what_a_node_sends_itself_is_taken_in_before_the_next_hook_too():
    """Else each event would let a hook start, and more would be sent than is handled."""
    bench = Bench(
        function("send", outputs="o", returns=1),
        function("take", "x"),
        connections=[wire("node.o -> node.x"), wire("a.o -> node.y")],
        is_started=False,
    )
    after_a_hook_something_may_have_arrived(bench)
    bench.engine.start()
    for _ in range(50):
        bench.is_taken_in = True
        bench.packet("a.o -> node.y")
        bench.is_taken_in = True
        bench.posted_event()
        assert len(bench.waiting) <= 3
    assert {"send", "take"} <= set(bench.ran[-3:])


def test_a_hook_that_takes_more_than_a_millisecond_gives_way_to_other_nodes():
    bench = Bench(function("f", "x"), connections=[wire(A)])
    for bench.hook_s, ways_given in (0.001, 0), (0.0011, 1), (0.0, 1):
        assert bench.packet(A) == ["f"]
        assert bench.ways_given == ways_given
