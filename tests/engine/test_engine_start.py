"""The start of a node: loaded, registered, ready; then every node of the project is."""

from __future__ import annotations

from typing import Any

import pytest
from engine_bench import Bench, function, initialise, tick, wire

from neuros.engine.metrics import State
from neuros.hooks import Optional

TO_B = wire("node.out -> b.in", discard_limit=0)
FROM_B = wire("b.out -> node.in", discard_limit=0)


def test_only_initialise_hooks_start_before_every_node_is_ready() -> None:
    bench = Bench(
        initialise("begin"),
        function("loop", outputs="out", returns="o"),
        tick("timed", 0.1),
        connections=[TO_B],
        is_started=False,
    )
    bench.engine.start(awaits_others=True)
    assert bench.pass_time(1.0) == []
    assert bench.ran == ["begin"]
    bench.activate()
    assert bench.ran == ["begin", "loop"]


def test_ticks_are_counted_from_then_also_behind_a_long_hook_of_another_node() -> None:
    bench = Bench(tick("timed", 0.1), is_started=False)
    bench.engine.start(awaits_others=True)
    bench.engine.activate()
    assert bench.pass_time(0.35) == ["timed"]
    assert bench.engine.all_hooks[0].missed_ticks == 2


def test_ticks_are_counted_from_when_every_node_is_ready() -> None:
    bench = Bench(tick("timed", 0.1), is_started=False)
    bench.engine.start(awaits_others=True)
    bench.pass_time(0.95)
    bench.activate()
    assert bench.pass_time(0.09) == []
    assert bench.pass_time(0.02) == ["timed"]
    assert bench.engine.all_hooks[0].missed_ticks == 0


def test_a_node_is_ready_once_its_initialise_hooks_have_run() -> None:
    bench = Bench(initialise("begin"), connections=[TO_B], is_started=False, is_registered=False)
    bench.engine.start(awaits_others=True)
    assert bench.told_ready == 0
    bench.register(str(TO_B))
    assert (bench.ran, bench.told_ready) == (["begin"], 1)


@pytest.mark.parametrize("sends", [{}, {"outputs": "out", "returns": "o"}])
def test_a_node_whose_initialise_hook_waits_for_another_node_is_ready(sends: Any) -> None:
    waits = initialise("waits", inputs="in", **sends)
    bench = Bench(initialise("begin"), waits, connections=[TO_B, FROM_B], is_started=False)
    bench.engine.start(awaits_others=True)
    assert (bench.ran, bench.told_ready) == (["begin"], 1)
    bench.activate()
    bench.packet(str(FROM_B))
    assert bench.ran == ["begin", "waits"]
    assert bench.told_ready == 1


def test_a_node_whose_initialise_hook_waits_for_a_receiver_is_ready() -> None:
    """The receiver takes the first packet with a hook that waits until every node is ready."""
    bench = Bench(
        initialise("first", outputs="out", returns=1),
        initialise("second", outputs="out", returns=2),
        connections=[TO_B],
        is_started=False,
    )
    bench.engine.start(awaits_others=True)
    assert (bench.ran, bench.told_ready) == (["first"], 1)
    bench.activate()
    bench.acknowledge_to_node(str(TO_B), 1)
    assert bench.ran == ["first", "second"]


def test_a_node_that_sends_to_itself_is_ready_when_it_has_taken_that() -> None:
    to_itself = wire("node.out -> node.in", discard_limit=0)
    bench = Bench(
        initialise("sends", outputs="out", returns=1),
        initialise("takes", inputs="in"),
        connections=[to_itself],
        is_started=False,
    )
    bench.engine.start(awaits_others=True)
    assert bench.told_ready == 0
    bench.settle()
    assert (bench.ran, bench.told_ready) == (["sends", "takes"], 1)


def test_a_hook_that_has_its_packets_waits_until_every_node_is_ready() -> None:
    bench = Bench(function("take", "in"), connections=[FROM_B], is_started=False)
    bench.engine.start(awaits_others=True)
    assert bench.packet(str(FROM_B)) == []
    assert bench.acknowledged == []
    bench.activate()
    assert bench.ran == ["take"]


def test_while_it_waits_for_others_its_time_is_that_of_registering() -> None:
    bench = Bench(tick("timed", 0.1), function("take", Optional("in")), is_started=False)
    bench.engine.start(awaits_others=True)
    assert bench.engine.rest().state is State.REGISTERING
    assert bench.engine.is_wakeable
    assert not bench.engine.is_active


def test_a_drain_before_that_lets_hooks_only_work_off_what_comes() -> None:
    bench = Bench(
        tick("timed", 0.1),
        function("loop", outputs="out", returns="o"),
        function("take", "in"),
        connections=[TO_B, FROM_B],
        is_started=False,
    )
    bench.engine.start(awaits_others=True)
    bench.packet(str(FROM_B))
    bench.engine.drain()
    bench.activate()
    bench.pass_time(1.0)
    assert bench.ran == ["take"]
