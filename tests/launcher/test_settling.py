"""When nothing moves any more in a run that is held: processes that exchange packets."""

from __future__ import annotations

import random
from collections import Counter, deque
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuros.control import Advance, AtRest, Message, Pause
from neuros.control.link import ControlLink
from neuros.launcher.channels import Channels, RestDetector

SESSION = cast(ControlLink, "the session")


class World:
    """Processes ``0``, ``1``, ...: each handles packets, and sends some on, until all are used up.

    What is on its way, and what the supervisor asks, arrives in any order but that of one sender.
    """

    def __init__(self, size: int, packets: int, source: random.Random) -> None:
        self.names = [str(number) for number in range(size)]
        self.greeted = set(self.names)
        self.source = source
        self.left = packets
        self.work = Counter({source.choice(self.names): 1})
        self.sent: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.on_way: dict[str, deque[str]] = {f"{a} -> {b}": deque() for a, b in self.pairs()}
        self.asked: dict[str, deque[Advance]] = {name: deque() for name in self.names}
        self.answers: deque[AtRest] = deque()
        self.settled: list[Message] = []
        self.now_s = 0.0
        self.settling = RestDetector(self.names, cast(Channels, self), lambda: self.now_s)

    def pairs(self) -> list[tuple[str, str]]:
        return [(a, b) for a in self.names for b in self.names if a != b]

    @property
    def moves(self) -> bool:
        return any(self.work.values()) or any(self.on_way.values())

    def send(self, message: Message) -> None:
        if isinstance(message, Advance):
            for name in self.names:
                self.asked[name].append(message)
        else:
            assert isinstance(message, Pause)

    def send_to(self, link: ControlLink, message: Message) -> None:
        assert link is SESSION
        assert not self.moves, "a packet was under way, or a hook was to run"
        self.settled.append(message)

    def turn(self) -> None:
        """One thing happens, whichever comes first."""
        ways: list[Any] = [(self.handle, name) for name in self.names if self.work[name]]
        ways += [(self.arrive, way) for way, queue in self.on_way.items() if queue]
        ways += [(self.answer, n) for n in self.names if self.asked[n] and not self.work[n]]
        ways += [(self.hear, "")] * bool(self.answers)
        if not ways or self.source.random() < 0.1:
            self.now_s += 0.01
            self.settling.check()
        else:
            act, name = self.source.choice(ways)
            act(name)

    def handle(self, name: str) -> None:
        self.work[name] -= 1
        for _ in range(self.source.randint(0, 2)):
            if self.left:
                self.left -= 1
                way = f"{name} -> {self.source.choice([n for n in self.names if n != name])}"
                self.sent[way] += 1
                self.on_way[way].append("packet")

    def arrive(self, way: str) -> None:
        self.on_way[way].popleft()
        self.received[way] += 1
        self.work[way.split()[-1]] += 1

    def answer(self, name: str) -> None:
        number = self.asked[name].popleft().number
        own = [way for way in self.on_way if way.split()[0] == name]
        others = [way for way in self.on_way if way.split()[-1] == name]
        sent = {way: (self.sent[way], 0) for way in own}
        received = {way: (self.received[way], 0) for way in others}
        self.answers.append(AtRest(number, {}, {}, (name,), True, sent, received))

    def hear(self, _: str) -> None:
        self.settling.add(self.answers.popleft())


@given(size=st.integers(2, 4), packets=st.integers(0, 30), seed=st.integers(0, 2**32))
def test_it_is_told_when_nothing_moves_and_not_before(size: int, packets: int, seed: int) -> None:
    world = World(size, packets, random.Random(seed))
    world.settling.ask(SESSION, Advance(7, 0, {}))
    for _ in range(20_000):
        if world.settled:
            break
        world.turn()
    assert world.settled == [AtRest(7, {}, {})]


class Asked:
    """Channels that note what is sent."""

    def __init__(self) -> None:
        self.greeted = {"a", "b"}
        self.rounds: list[Advance] = []
        self.told: list[Message] = []

    def send(self, message: Message) -> None:
        if isinstance(message, Advance):
            self.rounds.append(message)

    def send_to(self, _: ControlLink, message: Message) -> None:
        self.told.append(message)


@pytest.fixture
def asked() -> Asked:
    return Asked()


def test_one_process_is_asked_once(asked: Asked) -> None:
    settling = RestDetector(["a", "b"], cast(Channels, asked))
    settling.ask(SESSION, Advance(1, 0, {"a.x": 3}))
    assert asked.rounds == [Advance(1, 0, {"a.x": 3})]
    newest = {"a.x": (4, [b""])}
    settling.add(AtRest(1, {"a": 0.5}, newest, ("a", "b")))
    assert asked.told == [AtRest(1, {"a": 0.5}, newest)]


def test_packets_of_a_lossy_connection_are_given_up_after_a_while(asked: Asked) -> None:
    now_s = 0.0
    settling = RestDetector(["a", "b"], cast(Channels, asked), lambda: now_s)
    settling.ask(SESSION, Advance(1, 0, {}))
    while not asked.told:
        number = asked.rounds[-1].number
        settling.add(AtRest(number, {}, {}, ("a",), True, {"a.x -> b.y": (3, -1)}, {}))
        settling.add(AtRest(number, {}, {}, ("b",), True, {}, {"a.x -> b.y": (2, -1)}))
        now_s += 0.01
        settling.check()
    assert 0.1 <= now_s < 0.2


def test_nodes_that_have_not_begun_are_waited_for(asked: Asked) -> None:
    now_s = 0.0
    settling = RestDetector(["a", "b"], cast(Channels, asked), lambda: now_s)
    asked.greeted = {"a"}
    settling.ask(SESSION, Advance(1, 0, {}))
    assert not asked.rounds
    asked.greeted = {"a", "b"}
    now_s += 1.0
    settling.check()
    settling.add(AtRest(asked.rounds[-1].number, {}, {}, ("a", "b"), False, {}, {}))
    assert not asked.told
    now_s += settling.wait_s + 1.0
    settling.check()
    settling.add(AtRest(asked.rounds[-1].number, {}, {}, ("a", "b"), True, {}, {}))
    assert asked.told


def test_who_lets_the_run_go_on_is_answered_no_more_and_holds_it_no_more(asked: Asked) -> None:
    now_s = 0.0
    settling = RestDetector(["a"], cast(Channels, asked), lambda: now_s)
    settling.ask(SESSION, Advance(1, 0, {}))
    not_begun = AtRest(asked.rounds[-1].number, {}, {}, ("a",), False, {}, {})
    settling.add(not_begun)
    settling.give_up(cast(ControlLink, object()))
    now_s += settling.wait_s + 1.0
    settling.check()
    assert len(asked.rounds) == 2
    settling.give_up(SESSION)
    settling.add(AtRest(asked.rounds[-1].number, {}, {}, ("a",), True, {}, {}))
    now_s += 1.0
    settling.check()
    assert len(asked.rounds) == 2
    assert not asked.told
