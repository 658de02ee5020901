"""Nodes apart, each up to its horizon, do what they do in one queue."""

from __future__ import annotations

import heapq
import random
from collections import deque
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.engine import horizon
from neuros.engine.horizon import NEVER_NS, Horizon, Moment

END_NS = 3_000
"""Nodes send nothing after this time."""

Message = tuple[int, int]  # number of the channel, arrival time


@dataclass(frozen=True)
class Channel:
    source: int
    target: int
    delay_ns: int
    sent_at: str  # "end" of a hook, "start" of a hook, or "arrival" of a message


ANSWERS = ("start", "arrival")


def drawn(*key: int) -> int:
    return crc32(repr(key).encode())


@dataclass
class Behaviour:
    """What a node does: hooks of some duration, started by messages and by ticks."""

    name: int
    channels: list[Channel]
    period_ns: int  # 0: no ticks
    least_ns: int
    events: list[tuple[int, int, int]] = field(default_factory=list)  # time, order, channel or kind
    trace: list[tuple[int, int]] = field(default_factory=list)
    free_ns: int | None = None
    waiting: int = 0
    started: int = 0

    def __post_init__(self) -> None:
        if self.period_ns:
            heapq.heappush(self.events, (self.period_ns, 1_001, 0))

    @property
    def next_ns(self) -> int:
        """Its next event, the end of its hook left out."""
        return min((t for t, order, _ in self.events if order != 1_000), default=NEVER_NS)

    def handle(self) -> list[Message]:
        """Handle all events of its next instant; returns what it sends."""
        now_ns, sent = self.events[0][0], []
        while self.events and self.events[0][0] == now_ns:
            _, order, channel = heapq.heappop(self.events)
            self.trace.append((now_ns, order))
            if order == 1_000:
                self.free_ns = None
                for i, each in enumerate(self.channels):
                    if each.source == self.name and each.sent_at == "end":
                        key = drawn(self.name, self.started, i)
                        if key % 3 and now_ns < END_NS:
                            sent.append((i, now_ns + each.delay_ns + key % 7))
            elif order == 1_001:
                self.waiting += 1
                if now_ns + self.period_ns < END_NS:
                    heapq.heappush(self.events, (now_ns + self.period_ns, 1_001, 0))
            elif self.channels[channel].sent_at == "end":
                self.waiting += 1
                came_from = self.channels[channel].source
                for i, each in enumerate(self.channels):
                    ends = (each.source, each.target)
                    if each.sent_at == "arrival" and ends == (self.name, came_from):
                        sent.append((i, max(now_ns, self.free_ns or 0) + each.delay_ns))
        if self.free_ns is None and self.waiting:
            self.waiting = 0
            self.started += 1
            self.free_ns = now_ns + self.least_ns + drawn(self.name, self.started) % 40
            heapq.heappush(self.events, (self.free_ns, 1_000, 0))
            for i, each in enumerate(self.channels):
                if each.source == self.name and each.sent_at == "start" and now_ns < END_NS:
                    sent.append((i, now_ns + each.delay_ns))
        return sent

    def receive(self, channel: int, arrival_ns: int) -> None:
        heapq.heappush(self.events, (arrival_ns, channel, channel))


def in_order(channels: list[Channel], last: dict[int, int], message: Message) -> Message:
    """Messages of a channel arrive in their order."""
    channel, arrival_ns = message
    last[channel] = max(last.get(channel, 0), arrival_ns)
    return channel, last[channel]


def by_one_queue(nodes: list[Behaviour], channels: list[Channel]) -> None:
    last: dict[int, int] = {}
    while any(node.events for node in nodes):
        node = min((n for n in nodes if n.events), key=lambda n: n.events[0][0])
        for message in node.handle():
            channel, arrival_ns = in_order(channels, last, message)
            nodes[channels[channel].target].receive(channel, arrival_ns)


class Apart:
    """The same nodes, each with a horizon of its own; messages come in any order of topics."""

    def __init__(
        self, nodes: list[Behaviour], channels: list[Channel], seed: int, patience: float = 0.0
    ) -> None:
        self.nodes, self.channels = nodes, channels
        self.patience = patience
        self.random = random.Random(seed)
        self.topics: dict[tuple[int, int, str], deque[object]] = {}
        self.last: dict[int, int] = {}
        self.now_ns = [0] * len(nodes)
        self.states_sent = 0
        self.horizons = [self.horizon_of(node) for node in nodes]

    def horizon_of(self, node: Behaviour) -> Horizon:
        outward = [i for i, each in enumerate(self.channels) if each.source == node.name]
        return Horizon(
            str(node.name),
            {i: str(c.source) for i, c in enumerate(self.channels) if c.target == node.name},
            [
                horizon.Channel(i, str(c.target), c.delay_ns)
                for i, c in ((i, self.channels[i]) for i in outward)
            ],
        )

    def advance(self, node: Behaviour, *, is_patient: bool) -> None:
        mine = self.horizons[node.name]
        while node.events and not mine.waits_for(node.events[0][0]):
            self.now_ns[node.name] = node.events[0][0]
            mine.handle(node.events[0][0])
            for message in node.handle():
                channel, arrival_ns = in_order(self.channels, self.last, message)
                mine.send(channel, arrival_ns)
                target = self.channels[channel].target
                self.put(node.name, target, str(channel), (channel, arrival_ns))
        free_ns = -1 if node.free_ns is None else node.free_ns
        waits_ns = node.events[0][0] if node.events else -1
        moment = Moment(
            self.now_ns[node.name], node.next_ns, free_ns, waits_ns, mine.causes, zero_ns=0
        )
        for other, states in mine.news(moment, is_patient=is_patient):
            self.states_sent += 1
            self.topics[node.name, int(other), "time"] = deque([states])  # the newest counts

    def put(self, source: int, target: int, topic: str, what: object) -> None:
        self.topics.setdefault((source, target, topic), deque()).append(what)

    def run(self) -> None:
        for node in self.nodes:
            self.advance(node, is_patient=False)
        is_over = False
        while not is_over:
            self.deliver_all()
            for node in self.nodes:  # patience is over
                self.advance(node, is_patient=False)
            is_over = not any(self.topics.values())

    def deliver_all(self) -> None:
        while full := [key for key, topic in self.topics.items() if topic]:
            _, target, topic = key = self.random.choice(full)
            what: Any = self.topics[key].popleft()
            node = self.nodes[target]
            if topic == "time":
                self.horizons[target].learn(what)
            else:
                node.receive(*what)
                self.horizons[target].receive(int(topic))
            self.advance(node, is_patient=self.random.random() < self.patience)


@st.composite
def networks(draw: st.DrawFn) -> tuple[list[tuple[int, int]], list[Channel]]:
    count = draw(st.integers(1, 5))
    nodes = [
        (draw(st.sampled_from([0, 0, 70, 300])), draw(st.sampled_from([0, 5, 200])))
        for _ in range(count)
    ]
    delays = st.sampled_from([1, 2, 10, 500])
    channels = []
    for _ in range(draw(st.integers(0, 2 * count)) if count > 1 else 0):
        source = draw(st.integers(0, count - 1))
        target = draw(st.integers(0, count - 2))
        target += target >= source
        channels.append(Channel(source, target, draw(delays), "end"))
        if draw(st.booleans()):
            channels.append(Channel(target, source, draw(delays), draw(st.sampled_from(ANSWERS))))
    return nodes, channels


def made(nodes: list[tuple[int, int]], channels: list[Channel]) -> list[Behaviour]:
    return [
        Behaviour(name, channels, period, least + 1) for name, (period, least) in enumerate(nodes)
    ]


@given(network=networks(), seed=st.integers(0, 2**32), patience=st.sampled_from([0.0, 0.5, 1.0]))
@settings(max_examples=100, deadline=None)
def test_nodes_apart_handle_the_same_events_as_in_one_queue(
    network: tuple[list[tuple[int, int]], list[Channel]], seed: int, patience: float
) -> None:
    together = made(*network)
    by_one_queue(together, network[1])
    apart = Apart(made(*network), network[1], seed, patience)
    apart.run()
    assert [node.trace for node in apart.nodes] == [node.trace for node in together]


def test_a_source_without_answers_waits_for_a_slow_receiver() -> None:
    """Its messages wait at the receiver: their number stays within bounds."""
    source = Horizon("source", {}, [horizon.Channel(0, "sink", 10)])
    receiver = Horizon("sink", {0: "source"}, [])
    source.learn([receiver.state(Moment(0, NEVER_NS))])
    assert source.waits_for(0) == ""
    time_ns = sent = 0
    while not source.waits_for(time_ns):
        source.send(0, time_ns + 10)
        time_ns, sent = time_ns + 1, sent + 1
        assert sent < 1_000
    assert source.waits_for(time_ns) == "sink"
    for _ in range(sent):
        receiver.receive(0)
    source.learn([receiver.state(Moment(0, 10))])
    assert source.waits_for(time_ns) == "sink"  # received, and not handled
    source.learn([receiver.state(Moment(time_ns, time_ns))])
    assert source.waits_for(time_ns) == ""


def test_a_node_that_waits_asks_no_neighbour_whose_messages_all_bring_packets() -> None:
    names = {0: "talker", 1: "quiet"}
    talker = Horizon("talker", {}, [horizon.Channel(0, "sink", 10)])
    quiet = Horizon("quiet", {}, [horizon.Channel(1, "sink", 10)])
    sink = Horizon("sink", names, [])
    for time_ns in range(3):
        talker.send(0, time_ns + 10)
        sink.learn([talker.state(Moment(time_ns, time_ns + 1, zero_ns=0))])
        sink.learn([quiet.state(Moment(time_ns, time_ns + 1, zero_ns=0))])
    assert sink.waits_for(50)
    moment = Moment(0, 50, -1, 50, sink.causes, zero_ns=0)
    assert {*dict(sink.news(moment))} == {"talker", "quiet"}  # the first states
    later = moment._replace(now_ns=1)
    assert [name for name, _ in sink.news(later, is_patient=True)] == ["quiet"]
    assert sink.withholds
    assert "talker" in dict(sink.news(later))  # patience is over


def test_messages_with_a_long_delay_are_no_backlog() -> None:
    source = Horizon("source", {}, [horizon.Channel(0, "sink", 1_000_000)])
    source.learn([Horizon("sink", {0: "source"}, []).state(Moment(0, NEVER_NS))])
    for time_ns in range(10_000):
        assert source.waits_for(time_ns) == ""
        source.send(0, time_ns + 1_000_000)
