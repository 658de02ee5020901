"""The engine does exactly what a naive reading of the specification does, event by event."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import rosgraph_msgs.msg
from engine_bench import Clock, function, initialise, node_for, sim_tick, tick
from hypothesis import event, given, settings
from hypothesis import strategies as st
from naive_node import CLOCK, NaiveNode

from neuros.engine.engine import Engine
from neuros.engine.hook import Hook
from neuros.engine.sim_clock import with_clocks
from neuros.hooks import All, HookSpec, Optional
from neuros.project.model import Connection, Port
from neuros.project.qos import DEPTH
from neuros.time import to_stamp

INPUTS, OUTPUTS, OTHERS = ("x", "y"), ("o", "p"), ("a", "b")
PERIODS_S = (0.1, 0.25)
TOPIC = "topic"
EXTERNAL = Connection("", "", "node", TOPIC, queue_size=DEPTH)
"""An external topic, as the naive node sees it."""


class Written:
    """The engine's effects, written down as the naive node does it."""

    def __init__(self, produce: Callable[[HookSpec, int], list[Any]]) -> None:
        self.log: list[tuple[Any, ...]] = []
        self.events: deque[tuple[str, Callable[[], None]]] = deque()
        self.engine: Engine
        self._produce = produce

    def call(self, hook: Hook, arguments: Sequence[Any]) -> Any:
        now_ns = self.engine.sim_clock.now_ns
        sim_time = None if now_ns is None else Fraction(now_ns, 10**9)
        self.log.append(("run", hook.name, list(arguments), sim_time))
        packets = self._produce(hook.spec, hook.executions + 1)
        return packets if hook.spec.outputs else None

    def sender(self, port: Port, connections: Sequence[Connection]) -> Callable[[Any], None]:
        assert port.external_topic is None
        return lambda packet: self.log.extend(("send", str(c), packet) for c in connections)

    def has_taken_in(self) -> bool:
        return True

    def give_way(self) -> None: ...
    def note_ready(self) -> None: ...

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        return lambda position: self.log.append(("acknowledge", str(connection), position))

    def post(self, each: Callable[[], None]) -> None:
        self.events.append(("own packet", each))

    def post_loop_back(self, each: Callable[[], None]) -> None:
        self.events.append(("loop-back", each))

    def copy_to_itself(self, connection: Any, packet: Any) -> Any:
        return packet


limits = st.sampled_from([None, 0, 0, 1, 2])
sizes = st.sampled_from([1, 1, 2, 3])


@st.composite
def nodes(draw: st.DrawFn) -> tuple[list[Connection], list[HookSpec]]:
    """A node ``node`` with some connections, also to itself, and up to four hooks."""
    ends = [
        *((a, "o", "node", i) for a in OTHERS for i in INPUTS),
        *(("node", o, "node", i) for o in OUTPUTS for i in INPUTS),
        *(("node", o, b, "x") for o in OUTPUTS for b in OTHERS),
    ]
    chosen = draw(st.lists(st.sampled_from(ends), unique=True, min_size=1, max_size=6))
    has_clock, has_topic = draw(st.booleans()), draw(st.integers(0, 3)) == 0
    if has_clock:
        chosen.append(("world", "clock", "node", CLOCK))
    connections = [
        Connection(*end, discard_limit=draw(limits), queue_size=draw(sizes), index=index)
        for index, end in enumerate(chosen)
    ]
    connected = {c.destination_input for c in connections if c.destination_node == "node"}
    connected |= {TOPIC} if has_topic else set()
    specs = []
    for number in range(draw(st.integers(1, 4))):
        takes_clock = [CLOCK] if has_clock and draw(st.integers(0, 3)) == 0 else []
        inputs = takes_clock + [
            draw(_wrapped(name, name in connected))
            for name in draw(st.lists(st.sampled_from((*INPUTS, TOPIC)), unique=True))
            if name in (*INPUTS, *connected)
        ]
        outputs = [
            draw(st.sampled_from([name, Optional(name)]))
            for name in draw(st.lists(st.sampled_from(OUTPUTS), unique=True))
        ]
        kinds = ["function"] * 4 + ["initialise", "tick"] + ["sim tick"] * 3 * has_clock
        kind = draw(st.sampled_from(kinds))
        name = f"{kind}{number}"
        if kind == "function":
            specs.append(function(name, inputs, outputs))
        elif kind == "initialise":
            specs.append(initialise(name, inputs, outputs))
        else:
            make = tick if kind == "tick" else sim_tick
            specs.append(make(name, draw(st.sampled_from(PERIODS_S)), inputs, outputs))
    return connections, specs


def _wrapped(name: str, is_connected: bool) -> st.SearchStrategy[Any]:
    optional = [Optional(name), Optional(All(name))]
    return st.sampled_from([name, name, All(name), *optional] if is_connected else optional)


class Pair:
    """The engine and the naive node, fed with the same events."""

    def __init__(self, connections: list[Connection], specs: list[HookSpec], gaps: int) -> None:
        def produce(spec: HookSpec, count: int) -> list[Any]:
            return [
                None
                if port.is_optional and (count * 7 + place) % (gaps + 2) == 0
                else f"{spec.name}.{port.name}#{count}"
                for place, port in enumerate(spec.outputs)
            ]

        self.clock = Clock()
        self.effects = Written(produce)
        has_topic = any(port.name == TOPIC for spec in specs for port in spec.inputs)
        node = node_for("node", specs, connections, [TOPIC] if has_topic else [])
        ports = [
            replace(port, type="rosgraph_msgs/msg/Clock") if port.name == CLOCK else port
            for port in node.inputs
        ]
        node = replace(node, inputs=tuple(ports))
        self.engine = Engine(node, connections, with_clocks(node, specs), self.effects, self.clock)
        self.effects.engine = self.engine
        sources = [*connections, EXTERNAL] if has_topic else connections
        self.naive = NaiveNode("node", sources, specs, produce, self.clock)
        self.inbound = [c for c in self.naive.incoming if c.source_node != "node"]
        self.clocks = [c for c in self.inbound if c.destination_input == CLOCK]
        self.outbound = [c for c in self.naive.outgoing if c.destination_node != "node"]
        self.packets = 0
        self.sim_time_s = 0.0

    def step(self, kind: str, number: int) -> None:
        if kind == "packet" and self.inbound:
            self._packet(self.inbound[number % len(self.inbound)])
        elif kind == "clock" and self.clocks:
            self.sim_time_s = self.sim_time_s + number / 200 if number < 38 else 0.0
            self._packet(self.clocks[0])
        elif kind == "acknowledgement" and self.outbound:
            c = self.outbound[number % len(self.outbound)]
            self._both("on_acknowledgement", c, min(self.naive.sent[c], number // 4))
        elif kind == "acknowledge all":
            for c in self.outbound:
                self._both("on_acknowledgement", c, self.naive.sent[c])
        elif kind == "registration" and self.outbound:
            self._both("on_registered", self.outbound[number % len(self.outbound)])
        elif kind == "time":
            self.clock.advance(number / 100)
            due_ns = self.engine.next_due_ns
            if due_ns is not None and due_ns <= self.clock.now_ns:
                self._both("on_timer")
        elif kind == "pause":
            self._both(("pause", "resume")[number % 2])
        elif kind == "offer" and self.engine.outputs:
            self.packets += 1
            names = [name for place, name in enumerate(OUTPUTS, 1) if (1 + number % 3) & place]
            packets = {n: f"offer#{self.packets}" for n in names if n in self.engine.outputs}
            self._offer(packets or dict.fromkeys(self.engine.outputs, "offer"), self.packets)
        elif kind == "drain":
            places = range(len(self.naive.all_hooks))
            self._both("drain", [place for place in places if number >> place & 1])
        elif kind == "step":
            self._both("step", 1 + number % 3, is_driven=number % 4 > 0)
        elif kind == "posted" and self.naive.events:
            self.effects.events.popleft()[1]()
            self.naive.posted_event()
        self.compare()

    def _packet(self, c: Connection) -> None:
        if c.is_reliable:  # a sender keeps to its window
            outstanding = self.naive.arrived[c] - self.naive.acknowledged[c]
            if outstanding >= c.window:
                return
        self.packets += 1
        packet: Any = f"{c}#{self.packets}"
        if c.destination_input == CLOCK:
            packet = rosgraph_msgs.msg.Clock(clock=to_stamp(round(self.sim_time_s, 9)))
        self.engine.on_packet(TOPIC if c is EXTERNAL else c, packet)
        self.naive.on_packet(c, packet)

    def _offer(self, packets: dict[str, Any], number: int) -> None:
        self.engine.offer(packets, lambda: self.effects.log.append(("accepted", number)))
        self.naive.offer(packets, number)

    def _both(self, method: str, *arguments: Any, **options: Any) -> None:
        getattr(self.engine, method)(*arguments, **options)
        getattr(self.naive, method)(*arguments, **options)

    def compare(self) -> None:
        assert self.effects.log == self.naive.log
        assert [kind for kind, _ in self.effects.events] == [e[0] for e in self.naive.events]
        if not self.engine.is_paused:
            naive_ready = any(self.naive.is_ready(hook) for hook in self.naive.hooks)
            assert self.engine.has_ready_hook == naive_ready
        for c, window in self.engine.send_windows.items():
            assert window.sent == self.naive.sent[c]
            assert window.acknowledged == self.naive.acknowledged_by_receiver[c]
        for c in self.naive.incoming:
            self._compare_books(c)

    def _compare_books(self, c: Connection) -> None:
        subscription = self.engine.subscriptions[TOPIC if c is EXTERNAL else c]
        assert subscription.received == self.naive.arrived[c]
        assert (
            subscription.received
            == subscription.consumed + subscription.discarded + subscription.unread
        )
        takers = self.naive.takers(c)
        if len(takers) != sum(
            c.destination_input in {port.name for port in spec.spec.inputs}
            for spec in self.engine.all_hooks
        ):
            return  # an initialise hook has gone; what it took does not count any more
        everything = range(1, subscription.received + 1)
        lost = {n for n in everything if any(n in taker.lost[c] for taker in takers)}
        consumed = {n for n in everything if all(n in taker.started[c] for taker in takers)}
        assert subscription.discarded == len(lost)
        assert subscription.consumed == len(consumed)
        assert not lost & consumed


kinds = ["packet"] * 5 + ["posted"] * 4
kinds += ["acknowledgement", "acknowledge all", "time", "clock", "clock"] * 2
kinds += ["pause", "step", "offer"]
steps = st.lists(
    st.tuples(st.sampled_from([*kinds, "registration"]), st.integers(0, 40)),
    min_size=10,
    max_size=60,
)


@settings(max_examples=250, deadline=None)
@given(
    node=nodes(),
    steps=steps,
    gaps=st.integers(0, 3),
    is_registered_first=st.booleans(),
    drained_at=st.integers(0, 100),
)
def test_the_engine_agrees_with_the_naive_node(node, steps, gaps, is_registered_first, drained_at):
    pair = Pair(*node, gaps)
    pair._both("start")
    if is_registered_first:
        for c in pair.outbound:
            pair.step("registration", pair.outbound.index(c))
    for place, (kind, number) in enumerate(steps):
        if place == drained_at:
            pair.step("drain", number)
        pair.step(kind, number)
    runs = sum(entry[0] == "run" for entry in pair.naive.log)
    event("hooks ran: " + ("none" if not runs else "some" if runs < 10 else "many"))
