"""Ticks: due at start + k x period of the wall clock, coalescing, without drift."""

from __future__ import annotations

from engine_bench import SECOND, Bench, function, initialise, tick, wire
from hypothesis import given, settings
from hypothesis import strategies as st

IN, OUT = "a.o -> node.x", "node.o -> b.x"


def test_a_tick_hook_runs_once_per_period():
    bench = Bench(tick("t", 0.5))
    assert bench.ran == []
    assert [bench.pass_time(0.25) for _ in range(4)] == [[], ["t"], [], ["t"]]


def test_the_next_due_time_is_told_until_it_has_come():
    bench = Bench(tick("slow", 3.0), tick("fast", 2.0))
    assert bench.engine.next_due_ns == bench.engine.tick_start_ns + 2 * SECOND
    bench.pass_time(2.0)
    assert bench.engine.next_due_ns == bench.engine.tick_start_ns + 3 * SECOND


def test_a_timer_that_fires_early_does_nothing():
    bench = Bench(tick("t", 1.0))
    bench.clock.advance(0.999)
    bench.engine.on_timer()
    assert bench.ran == []
    assert bench.engine.next_due_ns is not None


def test_the_schedule_starts_at_the_end_of_initialisation():
    bench = Bench(initialise("init", "x"), tick("t", 1.0), connections=[wire(IN)])
    bench.pass_time(10.0)
    assert bench.engine.next_due_ns is None
    bench.hook_s = 0.5
    bench.packet(IN)
    assert bench.engine.tick_start_ns == bench.clock.now_ns
    assert bench.engine.next_due_ns == bench.clock.now_ns + SECOND


def test_the_schedule_does_not_drift():
    bench = Bench(tick("t", 1.0))
    start_ns = bench.engine.tick_start_ns
    for _ in range(50):
        bench.pass_time((bench.engine.next_due_ns - bench.clock.now_ns) / SECOND + 0.3)
    assert len(bench.ran) == 50
    assert bench.engine.next_due_ns == start_ns + 51 * SECOND


def test_ticks_that_pass_while_the_hook_cannot_run_coalesce_into_one():
    bench = Bench(tick("t", 1.0, outputs="o", returns=1), connections=[wire(OUT, 0)])
    bench.pass_time(1.0)
    for _ in range(4):
        assert bench.pass_time(1.0) == []
    bench.clock.advance(0.5)
    assert bench.acknowledge_to_node(OUT, 1) == ["t"]
    assert bench.hook("t").missed_ticks == 3
    assert bench.pass_time(0.4) == []  # the next one is due at 6 s, on the old schedule
    assert bench.engine.next_due_ns == bench.engine.tick_start_ns + 6 * SECOND


def test_ticks_that_pass_while_the_hook_itself_runs_coalesce_too():
    bench = Bench(tick("t", 1.0))
    bench.hook_s = 2.5
    bench.pass_time(1.0)  # until 3.5 s
    bench.hook_s = 0.0
    assert bench.engine.next_due_ns == bench.engine.tick_start_ns + 2 * SECOND
    assert bench.pass_time(0.0) == ["t"]
    assert bench.hook("t").missed_ticks == 1
    assert bench.engine.next_due_ns == bench.engine.tick_start_ns + 4 * SECOND


def test_a_tick_hook_waits_for_its_inputs_after_it_is_due():
    bench = Bench(tick("t", 1.0, "x"), connections=[wire(IN)])
    assert bench.pass_time(1.0) == []
    assert bench.packet(IN) == ["t"]
    assert bench.packet(IN) == []
    assert bench.pass_time(1.0) == ["t"]


def test_a_due_tick_hook_takes_its_turn_among_the_others():
    bench = Bench(function("f", "x"), tick("t", 1.0), connections=[wire(IN)])
    bench.packet(IN)
    bench.pass_time(1.0)
    assert bench.ran == ["f", "t"]


def test_a_tick_that_is_due_takes_its_turn_whatever_event_comes_first():
    """The loop may have much to do before it gets to the timer."""
    bench = Bench(function("main"), tick("t", 0.1))
    assert bench.ran == ["main"]
    bench.clock.advance(0.1)
    assert bench.posted_event() == ["t", "main"]


@settings(max_examples=50)
@given(
    period_ms=st.integers(1, 50),
    steps=st.lists(st.tuples(st.integers(0, 200), st.integers(0, 100)), max_size=30),
)
def test_every_tick_has_run_or_is_counted_as_missed(period_ms, steps):
    """... and none runs before it is due, nor twice."""
    bench = Bench(tick("t", period_ms / 1000))
    start_ns = bench.clock.now_ns
    last = 0
    for wait_ms, hook_ms in steps:
        bench.hook_s = hook_ms / 1000
        asked_ns = bench.clock.now_ns + wait_ms * 1_000_000
        passed = (asked_ns - start_ns) // (period_ms * 1_000_000)
        assert bench.pass_time(wait_ms / 1000) == (["t"] if passed > last else [])
        last = max(last, passed)
        assert bench.hook("t").executions + bench.hook("t").missed_ticks == last
