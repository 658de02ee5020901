"""Discard limits, send windows, input queues, acknowledgements, and a node connected to itself."""

from __future__ import annotations

from pathlib import Path

import pytest
from engine_bench import Bench, Clock, function, initialise, wire

from neuros.engine.connection_ends import SendWindow
from neuros.engine.engine import Engine
from neuros.errors import ProtocolError
from neuros.hooks import All, Optional
from neuros.project.model import Node, Port
from neuros.project.qos import Qos

A, B = "a.o -> node.x", "b.o -> node.x"
OUT = "node.o -> b.x"
OWN = "node.o -> node.x"


def sender(discard_limit: int | None, queue_size: int = 1) -> Bench:
    """A node that sends whenever it may; each hook run is one packet."""
    bench = Bench(
        function("f", outputs="o", returns=1),
        connections=[wire(OUT, discard_limit, queue_size)],
    )
    bench.settle(20)
    return bench


# ------------------------------------------------------------------ the sender's side


@pytest.mark.parametrize("queue_size", [1, 2, 5])
@pytest.mark.parametrize("discard_limit", [0, 1, 3])
def test_a_reliable_sender_blocks_while_k_plus_n_packets_are_outstanding(discard_limit, queue_size):
    bench = sender(discard_limit, queue_size)
    assert len(bench.sent) == queue_size + discard_limit


def test_a_best_effort_sender_never_blocks():
    assert len(sender(None).sent) == 21


def test_limit_0_is_one_packet_at_a_time():
    bench = sender(0)
    for position in (1, 2, 3):
        assert bench.acknowledge_to_node(OUT, position) == ["f"]


def test_acknowledgements_are_cumulative():
    bench = sender(2)
    bench.acknowledge_to_node(OUT, 3)
    bench.settle()
    assert len(bench.sent) == 6


@pytest.mark.parametrize("position", [1, 2])
def test_a_repeated_or_late_acknowledgement_does_no_harm(position):
    bench = sender(0)
    bench.acknowledge_to_node(OUT, 1)
    bench.acknowledge_to_node(OUT, 2)
    assert bench.acknowledge_to_node(OUT, position) == []
    assert len(bench.sent) == 3


def test_an_acknowledgement_of_what_was_never_sent_is_a_fault_of_the_neighbour():
    bench = sender(0)
    with pytest.raises(ProtocolError, match=rf"{OUT}: packet 2 was acknowledged, but only 1"):
        bench.acknowledge_to_node(OUT, 2)


def test_each_connection_of_an_output_has_its_own_window():
    bench = Bench(
        function("f", outputs="o", returns=1),
        connections=[wire(OUT, 2), wire("node.o -> c.x", 0), wire("node.o -> d.x")],
    )
    bench.settle()
    assert bench.engine.send_windows[bench.by_name["node.o -> c.x"]].is_blocked
    assert not bench.engine.send_windows[bench.by_name[OUT]].is_blocked
    assert bench.ran == ["f"]


def test_a_packet_for_an_output_that_nothing_is_connected_to_is_dropped_and_never_blocks():
    bench = Bench(function("f", outputs="o", returns=1))
    assert bench.settle(5) == ["f"] * 5
    assert bench.sent == []


def test_none_is_not_sent():
    bench = Bench(
        function("f", "x", Optional("o"), returns=None), connections=[wire(A), wire(OUT, 0)]
    )
    bench.packet(A)
    assert bench.sent == []
    assert bench.packet(A) == ["f"]


def test_an_external_output_never_blocks():
    bench = Bench(function("f", outputs="o", returns=1), external_outputs=["o"])
    bench.settle(3)
    assert bench.external == [("o", 1)] * 4


def test_outstanding_is_sent_minus_acknowledged():
    window = SendWindow(wire(OUT, 3))
    for _ in range(3):
        window.spend(0)
    window.credit(2, now_ns=0)
    assert window.outstanding == 1


def test_a_window_that_was_overfilled_stays_blocked_until_a_packet_fits():
    window = SendWindow(wire(OUT, 1))  # two packets may be outstanding
    for _ in range(5):
        window.spend(0)
    window.credit(3, now_ns=0)
    assert window.is_blocked
    window.credit(4, now_ns=0)
    assert not window.is_blocked


def test_nothing_is_outstanding_where_nothing_is_acknowledged():
    window = SendWindow(wire(OUT))
    window.spend(0)
    assert window.outstanding == 0


# ---------------------------------------------------------{10} the input queue


@pytest.mark.parametrize("queue_size", [1, 3])
def test_a_full_input_queue_discards_the_oldest_unread_packet_and_counts_it(queue_size):
    bench = Bench(
        function("f", ["x", "go"]), connections=[wire(A, 9, queue_size), wire("c.o -> node.go")]
    )
    for number in range(5):
        bench.packet(A, number)
    bench.packet("c.o -> node.go")
    assert bench.calls[0][1][0] == 5 - queue_size
    subscription = bench.engine.subscriptions[bench.by_name[A]]
    assert subscription.discarded == subscription.longest_discard == 5 - queue_size


def test_with_limit_0_a_full_input_queue_fails_loudly():
    bench = Bench(function("f", ["x", "go"]), connections=[wire(A, 0), wire("c.o -> node.go")])
    bench.packet(A)
    with pytest.raises(ProtocolError, match=f"{A} is lossless, yet packet 2 arrived"):
        bench.packet(A)


def test_the_input_queue_of_an_external_topic_holds_ten():
    bench = Bench(
        function("f", ["x", "go"]), connections=[wire("c.o -> node.go")], external_inputs=["x"]
    )
    for number in range(12):
        bench.packet("x", number)
    bench.packet("c.o -> node.go")
    assert bench.calls[0][1][0] == 2
    assert bench.engine.subscriptions["x"].discarded == 2


@pytest.mark.parametrize(("depth", "capacity"), [(3, 3), (0, 10)])
def test_the_depth_of_its_quality_of_service_is_that_of_the_input_queue(depth, capacity):
    port = Port("x", "std_msgs/msg/String", "/x", qos=Qos("reliable", depth=depth))
    node = Node("node", "neuros_python", Path("/project/plugin.py"), inputs=(port,))
    engine = Engine(node, [], [function("f", "x")], Bench(), Clock())
    assert engine.subscriptions["x"].capacity == capacity


def test_nothing_is_acknowledged_on_an_external_topic():
    bench = Bench(function("f", "x"), external_inputs=["x"])
    bench.packet("x")
    assert bench.acknowledged == []


# ------------------------------------------------------------------ acknowledgement


def test_an_acknowledgement_is_sent_when_a_hook_starts_and_not_on_arrival():
    bench = Bench(function("f", ["x", "y"]), connections=[wire(A, 0), wire("b.o -> node.y")])
    bench.packet(A)
    assert bench.acknowledged == []
    bench.packet("b.o -> node.y")
    assert bench.log == [("acknowledge", A, 1), ("start", "f"), ("end", "f")]


def test_a_discard_is_not_acknowledged():
    bench = Bench(function("f", ["x", "go"]), connections=[wire(A, 3), wire("c.o -> node.go")])
    for _ in range(4):
        bench.packet(A)
    assert bench.acknowledged == []


def test_the_position_counts_discarded_packets_too():
    bench = Bench(function("f", ["x", "go"]), connections=[wire(A, 3), wire("c.o -> node.go")])
    for _ in range(4):
        bench.packet(A)
    bench.packet("c.o -> node.go")
    assert bench.acknowledged == [(A, 4)]


def test_a_best_effort_connection_is_not_acknowledged():
    bench = Bench(function("f", "x"), connections=[wire(A)])
    bench.packet(A)
    assert bench.acknowledged == []


def test_the_smallest_position_over_all_takers_is_acknowledged_when_it_grows():
    bench = Bench(
        function("f", "x"),
        function("g", ["x", "go"]),
        connections=[wire(A, 0, queue_size=2), wire("c.o -> node.go")],
    )
    bench.packet(A)
    bench.packet(A)
    assert bench.ran == ["f", "f"]
    assert bench.acknowledged == []
    bench.packet("c.o -> node.go")
    assert bench.acknowledged == [(A, 1)]
    bench.packet("c.o -> node.go")
    assert bench.acknowledged == [(A, 1), (A, 2)]


def test_all_acknowledges_every_connection_that_it_takes_from():
    bench = Bench(function("f", All("x")), connections=[wire(A, 0), wire(B, 0)])
    bench.packet(A)
    bench.packet(B)
    assert bench.acknowledged == [(A, 1), (B, 1)]


def test_a_plain_input_acknowledges_only_the_connection_that_it_took_from():
    bench = Bench(
        function("f", ["x", "go"]), connections=[wire(A, 0), wire(B, 0), wire("c.o -> node.go")]
    )
    bench.packet(B)
    bench.packet(A)
    bench.packet("c.o -> node.go")
    assert bench.acknowledged == [(B, 1)]


def test_an_input_that_no_hook_takes_is_acknowledged_on_arrival():
    bench = Bench(connections=[wire(A, 0)])
    bench.packet(A)
    bench.packet(A)
    assert bench.acknowledged == [(A, 1), (A, 2)]
    assert [str(subscription.key) for subscription in bench.engine.untaken_subscriptions()] == [A]


def test_even_before_the_node_starts_and_after_it_has_stopped():
    bench = Bench(connections=[wire(A, 0)], is_started=False)
    bench.packet(A)
    bench.engine.start()
    bench.engine.stop_hooks()
    bench.packet(A)
    assert bench.acknowledged == [(A, 1), (A, 2)]


# ------------------------------------------------------------------ a node and itself


def test_a_connection_from_a_node_to_itself_never_touches_the_transport():
    bench = Bench(
        initialise("init", outputs="o", returns="ball"),
        function("f", "x"),
        connections=[wire(OWN, 0)],
    )
    bench.settle()
    assert bench.calls == [("init", ()), ("f", (("copy of", "ball"),))]
    assert bench.sent == bench.acknowledged == []


def test_its_delivery_is_an_event_queued_before_the_loop_back():
    bench = Bench(function("f", Optional("x"), "o", returns=1), connections=[wire(OWN, None)])
    assert bench.waiting == ["own packet", "loop-back"]


def test_one_output_may_feed_the_node_itself_and_others():
    bench = Bench(
        function("f", "go", "o", returns="ball"),
        function("g", "x"),
        connections=[wire("c.o -> node.go"), wire(OWN, 0), wire(OUT, 0)],
    )
    bench.packet("c.o -> node.go")
    bench.settle()
    assert bench.ran == ["f", "g"]
    assert bench.sent == [(OUT, "ball")]


def test_it_blocks_like_any_other():
    bench = Bench(
        function("f", "go", "o", returns=1),
        function("g", ["x", "go"]),
        connections=[wire("c.o -> node.go"), wire(OWN, 0)],
    )
    bench.packet("c.o -> node.go")
    assert bench.ran == ["f"]
    bench.settle()
    assert bench.ran == ["f", "g"]
    assert bench.packet("c.o -> node.go") == ["f"]


def test_a_hook_whose_start_takes_the_packet_that_blocks_it_is_not_blocked():
    bench = Bench(function("f", Optional("x"), "o", returns=1), connections=[wire(OWN, 0)])
    assert bench.ran == ["f"]
    assert bench.waiting == ["own packet"]  # blocked until it is there, so no loop-back
    assert bench.settle(5) == ["f"] * 5


def test_a_ring_of_one_node_with_a_packet_from_its_initialise_hook_goes_on_for_ever():
    bench = Bench(
        initialise("init", outputs="o", returns=0),
        function("f", "x", "o", returns=1),
        connections=[wire(OWN, 0)],
    )
    assert bench.settle(10) == ["f"] * 10


def test_it_stays_blocked_if_another_taker_has_not_started_on_that_packet():
    """Then its start would not make the acknowledged position grow."""
    bench = Bench(
        function("f", Optional("x"), "o", returns=1),
        function("g", ["x", "go"]),
        connections=[wire(OWN, 0), wire("c.o -> node.go")],
    )
    assert bench.settle(5) == []
    assert bench.packet("c.o -> node.go") == ["g", "f"]


def test_it_stays_blocked_if_its_start_would_take_another_connections_packet():
    bench = Bench(
        function("f", "x", "o", returns=1),
        connections=[wire(A, 0, 5), wire(OWN, 0)],
    )
    bench.packet(A, "a1")  # runs, and sends one to itself
    bench.packet(A, "a2")  # must wait: it is not there yet
    assert bench.ran == ["f"]
    bench.settle(1)  # it is there, but a2 has waited longer
    assert bench.ran == ["f"]


def test_it_stays_blocked_if_something_else_blocks_it_too():
    bench = Bench(
        function("f", Optional("x"), "o", returns=1), connections=[wire(OWN, 0), wire(OUT, 0)]
    )
    assert bench.settle() == []
    assert bench.acknowledge_to_node(OUT, 1) == ["f"]
