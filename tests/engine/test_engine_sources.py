"""Packets from a simulator's own thread: sent as if a hook with those outputs had returned them."""

from __future__ import annotations

import pytest
from engine_bench import Bench, function, initialise, wire

from neuros.errors import HookError, WrongValue

IN, OUT, OTHER = "a.o -> node.x", "node.o -> b.x", "node.p -> b.y"


def offer(bench: Bench, accepted: list, **packets):
    number = len(accepted)
    accepted.append(False)

    def accept():
        accepted[number] = True

    return bench.engine.offer(packets, accept)


def test_an_offer_is_sent_at_once_if_nothing_holds_it_up():
    bench, accepted = Bench(connections=[wire(OUT, 0)]), []
    offer(bench, accepted, o=1)
    assert bench.sent == [(OUT, 1)]
    assert accepted == [True]


def test_it_waits_while_a_reliable_connection_is_blocked():
    bench, accepted = Bench(connections=[wire(OUT, 0)]), []
    offer(bench, accepted, o=1)
    offer(bench, accepted, o=2)
    assert accepted == [True, False]
    bench.acknowledge_to_node(OUT, 1)
    assert bench.sent == [(OUT, 1), (OUT, 2)]
    assert accepted == [True, True]


def test_all_its_packets_are_sent_together():
    bench, accepted = Bench(connections=[wire(OUT, 0), wire(OTHER, 0)]), []
    offer(bench, accepted, o=1)
    offer(bench, accepted, o=2, p=3)
    assert bench.sent == [(OUT, 1)]
    bench.acknowledge_to_node(OUT, 1)
    assert sorted(bench.sent[1:]) == [(OUT, 2), (OTHER, 3)]


def test_offers_for_other_outputs_do_not_wait_for_each_other():
    bench, accepted = Bench(connections=[wire(OUT, 0), wire(OTHER, 0)]), []
    offer(bench, accepted, o=1)
    offer(bench, accepted, o=2)
    offer(bench, accepted, p=3)
    assert accepted == [True, False, True]


def test_several_offers_for_the_same_outputs_wait_in_line():
    bench, accepted = Bench(connections=[wire(OUT, 0)]), []
    for number in range(4):
        offer(bench, accepted, o=number)
    for position in (1, 2, 3):
        bench.acknowledge_to_node(OUT, position)
    assert [packet for _, packet in bench.sent] == [0, 1, 2, 3]
    assert all(accepted)


def test_it_is_told_only_when_it_has_been_sent():
    bench = Bench(connections=[wire(OUT, 0)])
    seen = []
    bench.engine.offer({"o": 1}, lambda: seen.extend(bench.sent))
    assert seen == [(OUT, 1)]


def test_the_next_offer_may_be_made_on_being_told():
    bench = Bench(connections=[wire(OUT, 1)])
    bench.engine.offer({"o": 1}, lambda: bench.engine.offer({"o": 2}, lambda: None))
    bench.settle()
    assert bench.sent == [(OUT, 1), (OUT, 2)]


def test_an_offer_can_be_withdrawn():
    bench, accepted = Bench(connections=[wire(OUT, 0)]), []
    offer(bench, accepted, o=1)
    withdraw = offer(bench, accepted, o=2)
    withdraw()
    bench.acknowledge_to_node(OUT, 1)
    assert bench.sent == [(OUT, 1)]
    assert accepted == [True, False]


def test_withdrawing_takes_back_that_very_offer_and_no_other():
    bench, accepted = Bench(connections=[wire(OUT, 0)]), []
    sent = offer(bench, accepted, o=1)
    first = offer(bench, accepted, o=2)
    offer(bench, accepted, o=3)
    sent()
    first()
    first()
    bench.acknowledge_to_node(OUT, 1)
    assert bench.sent == [(OUT, 1), (OUT, 3)]


def test_nothing_is_sent_before_registration_and_initialisation():
    bench, accepted = (
        Bench(initialise("init", "x"), connections=[wire(IN), wire(OUT)], is_registered=False),
        [],
    )
    offer(bench, accepted, o=1)
    bench.register(OUT)
    assert accepted == [False]
    bench.packet(IN)
    assert accepted == [True]


def test_it_takes_its_turn_least_recently_executed_first():
    bench, accepted = (
        Bench(
            function("f", "x", "o", returns="from f"), connections=[wire(IN, 0, 9), wire(OUT, 0)]
        ),
        [],
    )
    bench.packet(IN)
    offer(bench, accepted, o="offer")
    bench.packet(IN)
    bench.packet(IN)
    for position in (1, 2):
        bench.acknowledge_to_node(OUT, position)
    assert [packet for _, packet in bench.sent] == ["from f", "offer", "from f"]


@pytest.mark.parametrize("end", ["drain", "stop_hooks"])
def test_at_the_end_offers_are_no_longer_taken(end):
    bench, accepted = Bench(connections=[wire(OUT)]), []
    offer(bench, accepted, o=1)
    getattr(bench.engine, end)()
    offer(bench, accepted, o=2)
    assert accepted == [True, False]


def test_an_output_that_the_node_has_not_is_an_error():
    bench = Bench(connections=[wire(OUT)])
    with pytest.raises(HookError, match=r"declares no output 'q' \(it has o\)"):
        bench.engine.offer({"q": 1}, lambda: None)


def test_a_packet_of_a_wrong_type_is_an_error_and_is_not_accepted():
    bench, accepted = Bench(connections=[wire(OUT)], packet_types={"o": int}), []
    with pytest.raises(HookError, match=r"hook 'submit\(o\)': returned str for output 'o'"):
        offer(bench, accepted, o="text")
    assert accepted == [False]


def test_a_packet_with_a_wrong_value_is_an_error_and_nothing_is_sent():
    def check(packet):
        raise WrongValue("data", "300 (int)", "uint8: 0 to 255")

    bench, accepted = Bench(connections=[wire(OUT)], packet_types={"o": int}, check=check), []
    what = r"hook 'submit\(o\)': packet for output 'o': field 'data' must be uint8: 0 to 255"
    with pytest.raises(HookError, match=what) as caught:
        offer(bench, accepted, o=300)
    assert caught.value.where.endswith(".py")
    assert accepted == [False]
    assert bench.sent == []


def test_a_source_cannot_wake_the_node_since_threads_are_the_runtimes_business():
    bench, accepted = Bench(connections=[wire(OUT, 0)]), []
    offer(bench, accepted, o=1)
    assert not bench.engine.is_wakeable
    offer(bench, accepted, o=2)
    assert not bench.engine.is_wakeable
