"""Where a node's wall time goes, and whether its counters close."""

from __future__ import annotations

import json
import threading

import pytest
from engine_bench import Bench, function, initialise, tick, wire
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.engine.metrics import Rest, State
from neuros.engine.snapshot import snapshot, steadily
from neuros.hooks import Optional

IN, OUT, OWN = "a.o -> node.x", "node.o -> b.x", "node.o -> node.x"


def accounting(bench: Bench) -> dict:
    return snapshot(bench.engine, bench.clock())["accounting"]


# ------------------------------------------------------------------ time


def test_of_several_blocked_outputs_the_first_is_the_cause():
    bench = Bench(
        function("f", outputs=["o", "p"], returns=(1, 2)),
        connections=[wire("node.o -> b.x", 0), wire("node.p -> c.x", 0)],
    )
    assert bench.engine.rest() == (State.BLOCKED, "node.o -> b.x")


def test_executing_is_booked_per_hook():
    bench = Bench(function("f", "x"), function("g", "x"), connections=[wire(IN)])
    bench.hook_s = 2.0
    bench.packet(IN)
    assert accounting(bench)["executing"] == {"f": 2.0, "g": 2.0}


def test_waiting_is_booked_per_input():
    bench = Bench(function("f", ["x", "y"]), connections=[wire(IN), wire("b.o -> node.y")])
    bench.clock.advance(3)
    bench.packet(IN)
    bench.clock.advance(4)
    bench.packet("b.o -> node.y")
    assert accounting(bench)["waiting"] == {"x": 3.0, "y": 4.0}


def test_blocked_is_booked_per_connection():
    bench = Bench(
        function("f", outputs="o", returns=1),
        connections=[wire(OUT, 0), wire("node.o -> c.x", 0)],
    )
    bench.clock.advance(3)
    bench.acknowledge_to_node(OUT, 1)
    bench.clock.advance(4)
    bench.acknowledge_to_node("node.o -> c.x", 1)
    assert accounting(bench)["blocked"] == {OUT: 3.0, "node.o -> c.x": 4.0}


def test_a_hook_that_may_start_makes_the_node_busy_with_scheduling_until_it_is_stopped():
    bench = Bench(function("f", "x"), connections=[wire(IN)])
    bench.is_taken_in = False
    bench.packet(IN)
    assert bench.engine.rest() == Rest(State.SCHEDULING)
    bench.engine.stop_hooks()
    assert bench.engine.rest() == Rest(State.IDLE)


def test_a_node_that_is_stopped_still_names_the_input_that_it_lacks():
    bench = Bench(function("f", "x"), connections=[wire(IN)])
    bench.engine.stop_hooks()
    assert bench.engine.rest() == Rest(State.WAITING, "x")


def test_a_blocked_output_counts_before_a_missing_input():
    bench = Bench(
        function("f", "x"),
        function("g", outputs="o", returns=1),
        connections=[wire(IN), wire(OUT, 0)],
    )
    assert bench.engine.rest() == Rest(State.BLOCKED, OUT)


@pytest.mark.parametrize("inputs", [None, "x"])
def test_between_ticks_a_node_is_idle(inputs):
    bench = Bench(tick("t", 1.0, inputs), connections=[wire(IN)] if inputs else [])
    bench.pass_time(0.75)
    assert bench.engine.rest() == Rest(State.IDLE)
    assert accounting(bench)["idle"] == 0.75


def test_a_tick_that_is_due_waits_for_its_input():
    bench = Bench(tick("t", 1.0, "x"), connections=[wire(IN)])
    bench.pass_time(1.0)
    bench.clock.advance(2.0)
    assert accounting(bench)["waiting"] == {"x": 2.0}


def test_until_every_receiver_is_there_a_node_is_registering():
    bench = Bench(
        function("f", outputs="o", returns=1), connections=[wire(OUT)], is_registered=False
    )
    bench.clock.advance(5)
    bench.register(OUT)
    assert accounting(bench)["registering"] == 5.0


def test_time_between_an_event_and_a_hook_that_is_ready_is_scheduling():
    bench = Bench(function("f"))
    bench.clock.advance(1)
    bench.settle(1)
    assert accounting(bench)["scheduling"] == 1.0


def test_a_stopped_node_with_a_ready_hook_is_idle():
    bench = Bench(function("f"))
    bench.engine.stop_hooks()
    bench.clock.advance(1)
    assert bench.engine.rest() == Rest(State.IDLE)
    assert accounting(bench)["idle"] == 1.0


def test_draining_does_not_change_what_the_time_before_it_was_spent_on():
    bench = Bench(function("f", outputs="o", returns=1), connections=[wire(OUT, 0)])
    bench.clock.advance(3)
    bench.engine.drain()
    bench.clock.advance(1)
    assert accounting(bench)["blocked"] == {OUT: 3.0}
    assert accounting(bench)["idle"] == 1.0


def test_time_that_is_not_booked_yet_is_in_the_snapshot():
    bench = Bench(function("f", "x"), connections=[wire(IN)])
    bench.clock.advance(3)
    assert accounting(bench)["waiting"] == {"x": 3.0}
    assert accounting(bench)["total"] == 3.0


def test_so_is_the_time_of_a_hook_that_runs_now():
    bench = Bench(function("f", "x"), connections=[wire(IN)])
    seen = []
    bench.hook_s = 7.2
    bench.during_call = lambda: seen.append(snapshot(bench.engine, bench.clock()))
    bench.packet(IN)
    assert seen[0]["executing"] == {"name": "f", "for_s": 7.2, "executions": 0}
    assert seen[0]["state"] == {"state": "executing", "cause": "f"}
    assert seen[0]["accounting"]["executing"] == {"f": 7.2}


def total_of(books: dict) -> float:
    return sum(
        sum(share.values()) if isinstance(share, dict) else share
        for cause, share in books.items()
        if cause != "total"
    )


@settings(max_examples=60)
@given(
    events=st.lists(
        st.tuples(st.sampled_from("patrodes"), st.integers(0, 300), st.integers(0, 300)),
        max_size=40,
    )
)
def test_the_whole_wall_time_is_booked_and_nothing_is_negative(events):
    bench = Bench(
        initialise("init", "x"),
        function("f", "x", "o", returns=1),
        function("free", outputs="p", returns=1),
        tick("t", 0.2, Optional("x"), Optional("o"), returns=None),
        connections=[wire(IN), wire(OUT, 0), wire("node.p -> c.x", 1)],
        is_registered=False,
    )
    created_ns = bench.clock()
    free = bench.by_name["node.p -> c.x"]
    for kind, wait_ms, hook_ms in events:
        bench.clock.advance(wait_ms / 1000)
        bench.hook_s = hook_ms / 1000
        event_of = {
            "p": lambda: bench.packet(IN),
            "a": lambda: bench.engine.on_acknowledgement(
                free, bench.engine.send_windows[free].sent
            ),
            "t": bench.engine.on_timer,
            "r": lambda: [bench.register(str(c)) for c in bench.engine.send_windows],
            "o": lambda: bench.engine.offer({"o": 1}, lambda: None),
            "d": bench.engine.drain,
            "e": lambda: bench.settle(1),
            "s": bench.engine.stop_hooks,
        }
        event_of[kind]()
        spent = bench.engine.spent_ns
        busy_ns = sum(hook.busy_ns for hook in bench.engine.all_hooks)
        assert all(duration_ns >= 0 for duration_ns in spent.values())
        # What is not booked yet is what has passed since the engine's last entry.
        assert spent.total() + busy_ns == bench.engine.since_ns - created_ns
        books = accounting(bench)
        assert books["total"] == pytest.approx((bench.clock() - created_ns) / 1e9)
        assert total_of(books) == pytest.approx(books["total"])


# ------------------------------------------------------------------ packets


def incoming(bench: Bench, name: str = IN) -> tuple[int, int, int, int]:
    books = snapshot(bench.engine, bench.clock())["incoming"][name]
    assert books["received"] == books["consumed"] + books["discarded"] + books["unread"]
    return books["received"], books["consumed"], books["discarded"], books["unread"]


def two_takers() -> Bench:
    return Bench(
        function("f", ["x", "f_go"]),
        function("g", ["x", "g_go"]),
        connections=[wire(IN, 9), wire("c.o -> node.f_go"), wire("c.p -> node.g_go")],
    )


def test_consumed_counts_what_every_taker_started_on():
    bench = two_takers()
    bench.packet(IN)
    bench.packet("c.o -> node.f_go")
    assert incoming(bench) == (1, 0, 0, 1)
    bench.packet("c.p -> node.g_go")
    assert incoming(bench) == (1, 1, 0, 0)


def test_discarded_counts_what_at_least_one_skipped_once():
    bench = two_takers()
    bench.packet(IN)
    bench.packet("c.o -> node.f_go")  # f starts on the first, g does not
    bench.packet(IN)  # and loses it here
    assert incoming(bench) == (2, 0, 1, 1)
    bench.packet(IN)  # now both lose the second
    assert incoming(bench) == (3, 0, 2, 1)


def test_an_initialise_hook_that_has_gone_is_not_asked_any_more():
    bench = Bench(
        initialise("init", "x"),
        function("f", ["x", "go"]),
        connections=[wire(IN, 9, 2), wire("c.o -> node.go", 0, 5)],
    )
    for _ in range(3):
        bench.packet(IN)
    assert incoming(bench) == (3, 0, 1, 2)
    bench.packet("c.o -> node.go")
    bench.packet("c.o -> node.go")
    assert incoming(bench) == (3, 2, 1, 0)


def test_what_nobody_takes_is_consumed():
    bench = Bench(connections=[wire(IN, 0)])
    bench.packet(IN)
    assert incoming(bench) == (1, 1, 0, 0)


def test_the_longest_row_of_discards_is_kept():
    bench = Bench(function("f", ["x", "go"]), connections=[wire(IN, 9), wire("c.o -> node.go")])
    assert snapshot(bench.engine, 0)["incoming"][IN]["longest_discard"] == 0
    for count in (3, 5, 2):
        for _ in range(count):
            bench.packet(IN)
        bench.packet("c.o -> node.go")
    assert snapshot(bench.engine, 0)["incoming"][IN]["longest_discard"] == 4


# ------------------------------------------------------------------ the snapshot


def test_a_snapshot_is_plain_json_with_every_connection_and_hook():
    bench = Bench(
        function("f", ["x", "y"], "o", returns=1),
        tick("t", 1.0),
        connections=[wire(IN, 0), wire(OUT, 2, 3)],
        external_inputs=["y"],
    )
    bench.packet(IN)
    bench.packet("y")
    bench.pass_time(2.5)
    books = snapshot(bench.engine, bench.clock())
    assert json.loads(json.dumps(books)) == books
    assert books["outgoing"] == {
        OUT: {
            "sent": 1, "acknowledged": 0, "outstanding": 1, "window": 5,
            "is_reliable": True, "is_blocked": False,
        }
    }  # fmt: skip
    assert list(books["incoming"]) == [IN, "/y -> node.y"]
    assert books["incoming"][IN]["acknowledged"] == 1
    assert books["hooks"]["f"] == {"executions": 1, "busy_s": 0.0, "missed_ticks": 0}
    of_ticks = {"executions": 1, "busy_s": 0.0, "missed_ticks": 1, "ticks": None}
    assert books["hooks"]["t"] == of_ticks
    assert books["state"] == {"state": "waiting", "cause": "x"}
    assert books["executing"] is None


def test_a_read_that_is_disturbed_is_tried_again():
    attempts = iter([RuntimeError("dictionary changed size during iteration"), None])

    def read() -> str:
        if error := next(attempts):
            raise error
        return "read"

    assert steadily(read, "given up") == "read"


def test_a_snapshot_may_be_taken_while_the_engine_runs():
    bench = Bench(
        function("f", "x"),
        function("g", Optional("x"), "o", returns=1),
        connections=[wire(IN), wire(OUT, 1)],
    )
    failures = []
    is_over = threading.Event()

    def watch():
        try:
            while not is_over.is_set():
                books = snapshot(bench.engine, bench.clock())
                for each in books["incoming"].values():
                    assert each["unread"] >= 0
                for each in books["outgoing"].values():
                    assert each["outstanding"] >= 0
        except BaseException as error:
            failures.append(error)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        for number in range(2000):
            bench.clock.advance(0.001)
            bench.packet(IN)
            bench.settle(3)
            bench.acknowledge_to_node(OUT, len(bench.sent))
            if number % 100 == 0:
                bench.engine.offer({"o": number}, lambda: None)
    finally:
        is_over.set()
        watcher.join(10)
    assert failures == []
