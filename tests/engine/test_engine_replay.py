"""An event log makes an engine do again what it has done."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
from engine_bench import Bench, function, initialise, tick, wire
from hypothesis import given, settings
from hypothesis import strategies as st
from neuros_analysis.replay.script import (
    Player,
    ReplayedEngine,
    ReplayOver,
    ReplayParted,
    Script,
    callbacks_in,
    events_of,
    is_understood,
    is_whole,
    starts_of,
)

from neuros.engine.event_log import EventKind, LoggedEngine
from neuros.hooks import HookSpec, Optional
from neuros.project.model import Connection

CONNECTIONS = (
    wire("far.o -> node.x", discard_limit=None, queue_size=1, index=0),
    wire("far.o -> node.y", discard_limit=2, queue_size=2, index=1),
    wire("node.p -> far.p", discard_limit=0, queue_size=2, index=2),
    wire("node.q -> node.z", discard_limit=0, queue_size=1, index=3),
    wire("node.p -> away.p", discard_limit=1, queue_size=1, index=4),
)
INCOMING, OUTGOING = CONNECTIONS[:2], (CONNECTIONS[2], CONNECTIONS[4])


def hooks() -> list[HookSpec]:
    return [
        initialise("begin", outputs=Optional("q"), returns="q0"),
        function("loop", Optional("x"), "p", lambda x: f"p{x}"),
        function("joined", ["y", "z"], Optional("q"), lambda y, z: None if y % 3 == 0 else y),
        tick("timed", 0.01, outputs="q", returns="q1"),
        function("heard", "topic", returns=None),
    ]


def whole_bench(make_engine: Callable[..., Any], specs: list[HookSpec]) -> Bench:
    return Bench(
        *specs,
        connections=CONNECTIONS,
        external_inputs=["topic"],
        make_engine=make_engine,
        is_started=False,
        is_registered=False,
    )


def read_twice_or_not(bench: Bench) -> list[int]:
    """What every other hook reads of the clock."""
    times = 2 * (len(bench.calls) % 2)
    return [bench.engine.reading(bench.clock.now_ns + number) for number in range(times)]


class Run:
    """A node, and neighbours that keep the rules but for when they do something."""

    def __init__(self, specs: list[HookSpec], *, awaits_others: bool = False) -> None:
        self.bench = whole_bench(LoggedEngine, specs)
        self.bench.during_call = self.on_call
        self.calls_until_arrival = 0
        self.readings: list[int] = []
        self.arrived: dict[Connection | str, list[Any]] = {c: [] for c in INCOMING} | {"topic": []}
        engine = self.bench.engine
        for connection in (*OUTGOING, CONNECTIONS[3]):
            engine.on_registered(connection)
        engine.start(awaits_others=awaits_others)
        self.is_draining = False

    @property
    def event_log(self) -> array[int]:
        engine = self.bench.engine
        assert isinstance(engine, LoggedEngine)
        return engine.event_log

    def step(self, what: int, advance_ns: int) -> None:
        bench = self.bench
        bench.clock.now_ns += advance_ns
        if what < 3:
            key = [*self.arrived][what]
            subscription = bench.engine.subscriptions[key]
            window = key.window if isinstance(key, Connection) and key.is_reliable else 99
            if subscription.received - subscription.acknowledged < window:
                packet = len(self.arrived[key]) + 10 * what
                self.arrived[key].append(packet)
                bench.engine.on_packet(key, packet)
        elif what < 5:
            window = bench.engine.send_windows[OUTGOING[what - 3]]
            if window.acknowledged < window.sent:
                bench.engine.on_acknowledgement(OUTGOING[what - 3], window.acknowledged + 1)
        elif what == 5:
            due_ns = bench.engine.next_due_ns
            if due_ns is not None and due_ns <= bench.clock.now_ns:
                bench.engine.on_timer()
        elif what == 6 and bench.posted:
            bench.posted_event()
        elif what == 7:
            bench.engine.resume() if bench.engine.is_paused else bench.engine.pause()
        elif what == 8:
            bench.engine.step(2, is_driven=advance_ns % 2 == 0)
        elif what == 9 and not self.is_draining:
            self.is_draining = True
            places = range(len(bench.engine.all_hooks))
            bench.engine.drain([place for place in places if advance_ns >> place & 1])
        elif what == 10:
            bench.is_taken_in = not bench.is_taken_in
        elif what == 12:
            bench.engine.activate()
        elif what == 11:
            self.calls_until_arrival = 1 + advance_ns % 3

    def on_call(self) -> None:
        """The hook reads the clock; something may arrive meanwhile, so the pass ends after it."""
        self.readings += read_twice_or_not(self.bench)
        if self.calls_until_arrival:
            self.calls_until_arrival -= 1
            self.bench.is_taken_in = self.calls_until_arrival > 0


class Again:
    """The same node, on an event log (``Inbox`` and ``Source`` of the player)."""

    def __init__(self, run: Run, event_log: array[int], specs: list[HookSpec]) -> None:
        self._arrived = run.arrived
        self.script = Script(event_log)
        self.bench = whole_bench(partial(ReplayedEngine, self.script), specs)
        self.bench.post = self.script.deliveries.append  # type: ignore[method-assign]
        self.bench.post_loop_back = self._post_loop_back  # type: ignore[method-assign]
        self.bench.clock.now_ns = 0  # what hooks read is that of the log
        self.bench.during_call = self.on_call
        self.readings: list[int] = []
        engine: Any = self.bench.engine
        self.start, self.drain, self.stop = engine.start, engine.drain, engine.stop_hooks
        self.activate = engine.activate
        self.pause, self.resume, self.step = engine.pause, engine.resume, engine.step
        self.on_packet, self.on_timer = engine.on_packet, engine.on_timer
        self.on_acknowledgement = engine.on_acknowledgement
        self.on_registered = engine.on_registered

    def on_call(self) -> None:
        self.readings += read_twice_or_not(self.bench)

    def _post_loop_back(self, event: Callable[[], None]) -> None:
        self.script.loop_back = event

    def on_external_packet(self, port: Any, packet: Any) -> None:
        self.bench.engine.on_packet(port.name, packet)

    def packet(self, key: Connection | str, number: int) -> Any:
        return self._arrived[key][number - 1]

    def offer(self) -> None:
        raise AssertionError("there are no threads")

    def play(self) -> dict[int | None, list[str]]:
        """Returns what had run after the last event of each limit."""
        player = Player(self.script, self.bench.engine, self, self)
        ran: dict[int | None, list[str]] = {}
        for event in self.script.events():
            player.play(event)
            ran[event.limit] = self.bench.ran
        return ran


steps = st.lists(st.tuples(st.integers(0, 12), st.integers(0, 30_000_000)), max_size=150)


@settings(max_examples=150, deadline=None)
@given(steps, st.booleans())
def test_a_node_does_again_what_it_did(
    given_steps: list[tuple[int, int]], awaits_others: bool
) -> None:
    run = Run(hooks(), awaits_others=awaits_others)
    for what, advance_ns in given_steps:
        run.step(what, advance_ns)
    run.bench.engine.stop_hooks()
    event_log = run.event_log
    again = Again(run, event_log, hooks())
    again.play()
    assert again.bench.log == run.bench.log
    assert again.bench.calls == run.bench.calls
    assert again.bench.sent == run.bench.sent
    assert again.readings == run.readings
    assert not again.script.expects_start
    assert is_whole(event_log)
    assert len(list(starts_of(event_log))) == len(run.bench.calls)


def test_a_pass_that_ended_for_what_had_arrived_ends_there_again() -> None:
    specs = [function(name, "topic") for name in ("first", "second", "third")]
    run = Run(specs)
    for what, advance_ns in [(10, 0), (2, 0), (10, 0), (11, 1), (6, 0), (10, 0), (6, 0)]:
        run.step(what, advance_ns)
    event_log = run.event_log
    again = Again(run, event_log, specs)
    assert again.play()[2] == ["first", "second"]
    assert again.bench.ran == run.bench.ran == ["first", "second", "third"]


def some_run() -> tuple[Run, array[int]]:
    run = Run(hooks())
    for what in (6, 0, 3, 4, 6, 1, 6, 5, 6, 1, 3, 4, 6):
        run.step(what, 10_000_000)
    event_log = run.event_log
    return run, event_log


def test_where_an_event_log_was_cut_off_the_replay_is_over() -> None:
    run, event_log = some_run()
    assert not is_whole(event_log)
    last_start = max(place for place in range(len(event_log)) if [*starts_of(event_log[place:])])
    again = Again(run, event_log[:last_start], hooks())
    with pytest.raises(ReplayOver):
        again.play()
    assert again.bench.calls == run.bench.calls[: len(again.bench.calls)]
    assert len(again.bench.calls) == len(run.bench.calls) - 1


def test_a_plugin_whose_hooks_have_changed_is_told() -> None:
    run, event_log = some_run()
    begin, loop, *others = hooks()
    again = Again(run, event_log, [begin, function("other", "y"), loop, *others])
    with pytest.raises(ReplayParted, match="start 2 of a hook is of 'loop', but was of 'other'"):
        again.play()


def test_a_changed_plugin_that_sends_less_is_told_where_it_parts() -> None:
    """The acknowledgements of what it no longer sends are no error."""
    run, event_log = some_run()
    specs = hooks()
    specs[1] = function("loop", Optional("x"), Optional("p"))
    again = Again(run, event_log, specs)
    with pytest.raises(ReplayParted, match="is of 'loop', but was of 'joined'"):
        again.play()
    assert not again.bench.sent
    assert again.bench.ran == run.bench.ran[: len(again.bench.ran)]


def test_a_node_that_only_ticks_does_again_what_it_did() -> None:
    specs = [tick("timed", 0.01)]
    run = Run(specs)
    for late_ns in (0, 3_000_000, 25_000_000):
        run.step(5, 10_000_000 + late_ns)
    assert run.bench.ran == ["timed"] * 3
    again = Again(run, run.event_log, specs)
    again.play()
    assert again.bench.ran == run.bench.ran
    assert again.bench.hook("timed").missed_ticks == run.bench.hook("timed").missed_ticks > 0


def test_a_node_without_ticks_notes_no_time() -> None:
    bench = Bench(function("f", "x"), connections=[INCOMING[0]], make_engine=LoggedEngine)
    bench.packet(str(INCOMING[0]))
    assert isinstance(bench.engine, LoggedEngine)
    assert not any(event.readings for event in events_of(bench.engine.event_log))


def test_a_hook_that_reads_more_than_in_the_run_gets_what_is_there_now() -> None:
    bench = Bench(function("f", "x"), connections=[INCOMING[0]], make_engine=LoggedEngine)
    bench.during_call = lambda: bench.engine.reading(7)
    bench.packet(str(INCOMING[0]))
    assert isinstance(bench.engine, LoggedEngine)
    script = Script(bench.engine.event_log)
    values = [[script.reading(1), script.reading(2)] for _ in script.events()]
    assert values[-1] == [7, 2]


def test_a_reading_that_was_cut_off_is_none() -> None:
    engine = LoggedEngine.__new__(LoggedEngine)
    engine.event_log = array("q")
    engine._record = engine.event_log.append
    engine.reading(3)
    assert [event.hook_readings for event in events_of(engine.event_log)] == [[3]]
    assert [event.hook_readings for event in events_of(engine.event_log[:1])] == [[]]


def test_callbacks_of_a_plugin_are_counted_and_are_no_events() -> None:
    bench = Bench(function("f", "x"), connections=[INCOMING[0]], make_engine=LoggedEngine)
    bench.engine.note_callback()
    bench.packet(str(INCOMING[0]))
    bench.engine.note_callback()
    assert isinstance(bench.engine, LoggedEngine)
    assert callbacks_in(bench.engine.event_log) == 2
    kinds = [event.kind for event in events_of(bench.engine.event_log)]
    assert EventKind.CALLBACK not in kinds


def test_every_kind_of_entry_has_a_number_of_its_own() -> None:
    assert len({kind.value for kind in EventKind.__members__.values()}) == len(
        EventKind.__members__
    )


def test_a_log_with_an_entry_of_no_kind_is_not_understood() -> None:
    _, event_log = some_run()
    assert is_understood(event_log)
    assert not is_understood([*event_log, ~31])


def test_a_clock_may_stand_at_zero() -> None:
    _, event_log = some_run()
    assert next(events_of([0, *event_log])).readings[0] == 0


def test_events_carry_their_place_and_position() -> None:
    _, event_log = some_run()
    found = [(event.kind, event.place, event.position) for event in events_of(event_log)]
    assert found[0] == (EventKind.BEGIN, 0, 0)
    assert (EventKind.ACKNOWLEDGEMENT, 2, 1) in found
    assert (EventKind.REGISTERED, 4, 0) in found
