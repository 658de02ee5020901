"""Drained, dead, at rest, and who waits for whom: judged from the probes of all nodes."""

from __future__ import annotations

import random
from collections import Counter, deque
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.control import Advance, AtRest, Message, NodeProbe, Probe, Probed
from neuros.launcher.quiescence import (
    Probing,
    Verdict,
    counters,
    cycle,
    is_at_rest,
    is_dead,
    is_drained,
    reliable_counters,
    under_way,
    waits,
)
from neuros.project.model import Connection


def wire(text: str, discard_limit: int | None = 0, index: int = 0) -> Connection:
    """A connection from ``"a.out -> b.in"``."""
    source, destination = text.split(" -> ")
    return Connection(*source.split("."), *destination.split("."), discard_limit, index=index)


AB = wire("a.o -> b.x")
BA = wire("b.o -> a.x", index=1)
LOSSY = wire("a.p -> b.y", None, index=2)


def sender(connection: Connection, *sent: int, **more: Any) -> NodeProbe:
    """A node that has sent so many packets, of which so many were acknowledged."""
    return NodeProbe(sent={str(connection): sent}, **more)


def receiver(connection: Connection, *received: int, **more: Any) -> NodeProbe:
    return NodeProbe(received={str(connection): received}, **more)


def both(
    at_a: tuple[int, int], at_b: tuple[int, int], connection: Connection = AB, **of_b: Any
) -> dict[str, NodeProbe]:
    return {"a": sender(connection, *at_a), "b": receiver(connection, *at_b, **of_b)}


# ------------------------------------------------------------------ drained, dead, at rest


def test_when_all_packets_and_acknowledgements_have_arrived_nothing_moves() -> None:
    probes = both((3, 3), (3, 3))
    assert is_drained(probes, [AB])
    assert is_dead(probes, [AB])
    assert is_at_rest(probes, [AB], 0.0)
    assert under_way(probes, [AB]) == []


@pytest.mark.parametrize(
    ("at_a", "at_b"), [((3, 2), (2, 2)), ((3, 2), (3, 3))], ids=["a packet", "an acknowledgement"]
)
def test_what_is_under_way_is_named_and_moves(at_a: tuple[int, int], at_b: tuple[int, int]) -> None:
    probes = both(at_a, at_b)
    assert not is_drained(probes, [AB])
    assert not is_dead(probes, [AB])
    assert not is_at_rest(probes, [AB], 100.0)
    assert under_way(probes, [AB]) == ["a.o -> b.x"]


def test_a_packet_that_a_hook_could_start_on_has_to_be_worked_on_first() -> None:
    assert not is_drained(both((3, 2), (3, 2), is_startable=True), [AB])


def test_a_packet_that_no_hook_can_start_on_does_not_hold_up_the_end() -> None:
    assert is_drained(both((3, 2), (3, 2)), [AB])


def test_packets_that_may_be_lost_do_not_hold_up_the_end_and_a_step_only_shortly() -> None:
    probes = both((9, 0), (4, 0), LOSSY, is_idle=False)
    assert is_drained(probes, [LOSSY])
    assert reliable_counters(probes, [LOSSY]) == ()
    assert not is_at_rest(probes, [LOSSY], 0.09)
    assert is_at_rest(probes, [LOSSY], 0.1)


def test_in_virtual_time_they_do_since_they_arrive_at_the_same_time_in_every_run() -> None:
    probes = both((9, 0), (4, 0), LOSSY, virtual_ns=0)
    assert is_drained(probes, [LOSSY])
    probes["a"] = sender(LOSSY, 9, 0, is_idle=False, virtual_ns=0)
    assert not is_drained(probes, [LOSSY])


def test_in_virtual_time_what_was_sent_and_not_lost_holds_up_a_step_for_however_long() -> None:
    assert not is_at_rest(both((9, 0), (4, 0), LOSSY, virtual_ns=0), [LOSSY], 1e3)
    assert is_at_rest(both((4, 0), (4, 0), LOSSY, virtual_ns=0), [LOSSY], 0.0)


def test_connections_to_nodes_that_never_began_do_not_count() -> None:
    assert is_drained({"a": sender(AB, 0, 0)}, [AB])


def test_a_project_is_dead_when_nothing_can_wake_any_node() -> None:
    assert is_dead(both((1, 0), (1, 0)), [AB])


@pytest.mark.parametrize("change", [{"is_wakeable": True}, {"is_idle": False}], ids=str)
def test_one_node_that_could_still_do_something_is_enough(change: dict[str, bool]) -> None:
    assert not is_dead(both((1, 0), (1, 0), **change), [AB])


def test_a_run_is_not_at_rest_before_each_node_may_start_its_hooks() -> None:
    assert not is_at_rest(both((0, 0), (0, 0), is_active=False), [AB], 100.0)


def test_every_count_tells_whether_something_has_happened() -> None:
    before = counters(both((1, 0), (1, 0)))
    assert before == counters(dict(reversed(both((1, 0), (1, 0)).items())))
    assert before != counters(both((1, 1), (1, 0)))
    assert before != counters(both((1, 0), (1, 1)))
    assert before != counters(both((1, 0), (1, 0), executions=1))


# ------------------------------------------------------------------ who waits for whom


def node(sent: Any, received: Any, **more: Any) -> NodeProbe:
    return NodeProbe(
        sent={str(key): counts for key, counts in sent.items()},
        received={str(key): counts for key, counts in received.items()},
        **more,
    )


def test_a_ring_of_full_connections_is_named_with_its_connections() -> None:
    a, b = node({AB: (1, 0)}, {BA: (1, 0)}), node({BA: (1, 0)}, {AB: (1, 0)})
    assert cycle(waits({"a": a, "b": b}, [AB, BA])) == [
        ("a", "is blocked on `a.o -> b.x` (1 outstanding)"),
        ("b", "is blocked on `b.o -> a.x` (1 outstanding)"),
    ]


def test_a_ring_of_missing_inputs_is_named_with_the_inputs() -> None:
    a = node({AB: (0, 0)}, {BA: (0, 0)}, lacks="x")
    b = node({BA: (0, 0)}, {AB: (0, 0)}, lacks="x")
    assert cycle(waits({"a": a, "b": b}, [AB, BA])) == [
        ("a", "waits for `x` from b"),
        ("b", "waits for `x` from a"),
    ]


def test_who_has_delivered_is_not_waited_for_nor_a_packet_to_itself() -> None:
    """a takes all of b and c, and its own; only c's is missing, and c is blocked on b."""
    own, from_b, from_c = wire("a.o -> a.own"), wire("b.o -> a.x", index=1), wire("c.o -> a.x")
    to_b, missing = wire("c.o -> b.y"), wire("a.o -> b.z")
    full, free = (1, 0), (1, 1)
    unread = frozenset({str(own), str(from_b)})
    a = node({own: full, missing: free}, {}, unread=unread, lacks="x")
    b = node({from_b: full}, {}, unread=frozenset({str(to_b)}), lacks="z")
    c = node({from_c: free, to_b: full}, {})
    graph = waits({"a": a, "b": b, "c": c}, [own, from_b, from_c, to_b, missing])
    assert cycle(graph) == [
        ("a", "waits for `x` from c"),
        ("c", "is blocked on `c.o -> b.y` (1 outstanding)"),
        ("b", "waits for `z` from a"),
    ]


def test_a_dead_end_beside_the_ring_is_left_out() -> None:
    graph = {"a": {"b": "1", "c": "2"}, "b": {}, "c": {"a": "3"}, "d": {"a": "4"}}
    assert cycle(graph) == [("a", "2"), ("c", "3")]


def test_without_a_ring_every_wait_is_named() -> None:
    assert cycle({"a": {"b": "waits"}, "b": {}}) == [("a", "waits")]


NODES = "abcde"
GRAPHS = st.dictionaries(
    st.sampled_from(NODES), st.dictionaries(st.sampled_from(NODES), st.just("why"))
)


@settings(max_examples=100)
@given(GRAPHS)
def test_a_ring_is_found_exactly_where_there_is_one(graph: dict[str, dict[str, str]]) -> None:
    names = [name for name, _ in cycle(graph)]
    if not _has_ring(graph):
        assert sorted(names) == sorted(name for name in graph if graph[name])
        return
    assert len(set(names)) == len(names)
    for one, next_one in zip(names, [*names[1:], names[0]], strict=True):
        assert next_one in graph[one]


def _has_ring(graph: dict[str, dict[str, str]]) -> bool:
    """Whether something is left when nodes that wait for nobody are taken away, again and again."""
    left = {name: set(graph.get(name, ())) for name in NODES}
    while free := [name for name, others in left.items() if not others & left.keys()]:
        for name in free:
            del left[name]
    return bool(left)


# ------------------------------------------------------------------ rounds of probes


class World:
    """Processes of one node each, which handle packets, and send some on until all are used up.

    What is under way arrives in any order but that of one connection, questions and answers of the
    launcher among it.
    """

    def __init__(self, size: int, packets: int, source: random.Random) -> None:
        self.names = "abcd"[:size]
        pairs = [(a, b) for a in self.names for b in self.names if a != b]
        self.connections = [wire(f"{a}.{b} -> {b}.{a}") for a, b in pairs]
        self.source, self.left = source, packets
        self.sent, self.received, self.taken, self.acknowledged = (Counter[str]() for _ in range(4))
        self.data: dict[str, deque[int]] = {str(c): deque() for c in self.connections}
        self.acks: dict[str, deque[int]] = {str(c): deque() for c in self.connections}
        self.asked: dict[str, deque[Probe]] = {name: deque() for name in self.names}
        self.answers: deque[Probed] = deque()
        self.now_s = 0.0
        self.probing = Probing(self.names, self.connections, self.ask)
        self.send(self.names[0])

    def ask(self, message: Message) -> None:
        assert isinstance(message, Probe)
        for name in self.names:
            self.asked[name].append(message)

    def unread(self, name: str) -> list[str]:
        """The connections on which packets wait."""
        into = [str(c) for c in self.connections if c.destination_node == name]
        return [key for key in into if self.received[key] > self.taken[key]]

    @property
    def moves(self) -> bool:
        return any((*self.data.values(), *self.acks.values(), *map(self.unread, self.names)))

    def turn(self) -> None:
        """One thing happens, whichever comes first."""
        ways: list[Any] = [(self.handle, name) for name in self.names if self.unread(name)]
        ways += [(self.arrive, key) for key, under_way in self.data.items() if under_way]
        ways += [(self.credit, key) for key, under_way in self.acks.items() if under_way]
        ways += [
            (self.answer, name)
            for name, asked in self.asked.items()
            if asked and not (asked[0].once_idle and self.unread(name))
        ]
        ways += [(self.hear, "")] * bool(self.answers)
        if not ways or self.source.random() < 0.1:
            self.now_s += 0.01
            self.probing.check(self.now_s, 0.0)
        else:
            act, name = self.source.choice(ways)
            act(name)

    def send(self, name: str) -> None:
        key = str(self.source.choice([c for c in self.connections if c.source_node == name]))
        self.sent[key] += 1
        self.data[key].append(self.sent[key])

    def handle(self, name: str) -> None:
        key = self.source.choice(self.unread(name))
        self.taken[key] += 1
        self.acks[key].append(self.taken[key])
        for _ in range(min(self.left, self.source.randint(0, 2))):
            self.left -= 1
            self.send(name)

    def arrive(self, key: str) -> None:
        self.received[key] = self.data[key].popleft()

    def credit(self, key: str) -> None:
        self.acknowledged[key] = self.acks[key].popleft()

    def answer(self, name: str) -> None:
        number = self.asked[name].popleft().number
        out_of = [str(c) for c in self.connections if c.source_node == name]
        into = [str(c) for c in self.connections if c.destination_node == name]
        probe = NodeProbe(
            sent={key: (self.sent[key], self.acknowledged[key]) for key in out_of},
            received={key: (self.received[key], self.taken[key]) for key in into},
            is_startable=bool(self.unread(name)),
        )
        self.answers.append(Probed(number, {name: probe}))

    def hear(self, _: str) -> None:
        self.probing.add(self.answers.popleft(), self.now_s)


@pytest.mark.parametrize("goal", [Verdict.DRAINED, Verdict.AT_REST])
@settings(max_examples=100)
@given(size=st.integers(2, 4), packets=st.integers(0, 30), seed=st.integers(0, 2**32))
def test_it_is_found_when_nothing_moves_and_not_before(
    goal: Verdict, size: int, packets: int, seed: int
) -> None:
    world = World(size, packets, random.Random(seed))
    if goal is Verdict.DRAINED:
        world.probing.drain(without=(), now_s=0.0)
    else:
        world.probing.await_rest(Advance(7, 0, {}), 0.0)
    for _ in range(20_000):
        if world.probing.verdict is not Verdict.UNDECIDED:
            break
        world.turn()
    assert world.probing.verdict is goal
    assert not world.moves, "a packet was under way, or a hook was to run"


class Asked:
    """A probing of nodes that answer when the test says so."""

    def __init__(self, names: str, *connections: Connection) -> None:
        self.asked: list[Probe] = []
        self.are_there = True
        self.probing = Probing(names, connections, self._note, None, lambda: self.are_there)

    def _note(self, message: Message) -> None:
        assert isinstance(message, Probe)
        self.asked.append(message)

    @property
    def numbers(self) -> list[int]:
        return [probe.number for probe in self.asked]

    def answer(self, now_s: float, packets: Any = None, **nodes: NodeProbe) -> Verdict:
        """The answer of a process to the last question."""
        self.probing.add(Probed(self.asked[-1].number, nodes, packets or {}), now_s)
        return self.probing.verdict


def test_a_project_that_rests_is_found_drained_after_two_rounds() -> None:
    project = Asked("ab", AB)
    project.probing.drain(without=(), now_s=0.0)
    verdicts = []
    for now_s in (1.0, 2.0):
        verdicts.append(project.answer(now_s, **both((3, 3), (3, 3))))
        project.probing.check(now_s + 0.5, 0.0)
    assert verdicts == [Verdict.UNDECIDED, Verdict.DRAINED]
    assert project.numbers == [1, 2]


def test_answers_to_older_questions_do_not_count() -> None:
    project = Asked("a")
    project.probing.drain(without=(), now_s=0.0)
    project.probing.add(Probed(0, {"a": NodeProbe()}), 0.0)
    project.probing.check(1.0, 0.0)
    assert project.numbers == [1], "nobody has answered yet"


def test_without_a_node_that_ever_began_there_is_nothing_to_drain() -> None:
    project = Asked("ab", AB)
    project.probing.drain(without="ab", now_s=0.0)
    assert project.probing.check(0.0, 0.0) is Verdict.DRAINED


def test_nobody_is_asked_while_something_moves() -> None:
    project = Asked("a")
    project.probing.check(10.0, 0.9)
    assert project.asked == []
    project.probing.check(11.0, 1.0)
    project.probing.check(11.1, 1.1)
    assert project.numbers == [1], "and then not too often"


def test_the_longer_nothing_moves_the_more_rarely_nodes_are_asked_until_something_does() -> None:
    project, asked = Asked("a"), []
    for tick in range(1, 600):
        now_s = tick / 10
        project.probing.check(now_s, now_s - (50.0 if now_s >= 50.0 else 0.0))
        if len(project.asked) > len(asked):
            asked.append(now_s)
            project.answer(now_s, a=NodeProbe(is_wakeable=True))
    assert asked[:5] == [1.0, 1.5, 2.5, 4.5, 6.5], "two soon, for a deadlock; then ever later"
    assert [at for at in asked if at >= 50.0][:3] == [51.0, 51.5, 52.5], "and soon again"


@pytest.mark.parametrize(
    ("at_a", "b", "said"),
    [
        ((1, 0), receiver(AB, 1, 0), "a is blocked on `a.o -> b.x` (1 outstanding)"),
        (
            (0, 0),
            receiver(AB, 0, 0, lacks="x"),
            "b waits for `x` from a. No hook of a is left to run: let one send or take what is"
            " waited for; or leave out discard_limit",
        ),
        (
            (0, 0),
            receiver(AB, 0, 0),
            "deadlock: nothing can ever run again: no hook can run. If the work is done, let a hook"
            " call node.shutdown",
        ),
    ],
    ids=["blocked", "waits", "has no hook left"],
)
def test_a_deadlock_is_found_after_two_rounds_and_explained_with_its_cures(
    at_a: tuple[int, int], b: NodeProbe, said: str
) -> None:
    project = Asked("ab", AB)
    for now_s in (10.0, 11.0):
        assert project.probing.check(now_s, now_s) is Verdict.UNDECIDED
        project.answer(now_s, a=sender(AB, *at_a), b=b)
    assert project.probing.check(11.1, 11.1) is Verdict.DEAD
    assert said in project.probing.why_dead()
    assert "loop" not in project.probing.why_dead()


def test_what_is_left_names_who_is_busy_or_where_packets_are() -> None:
    project = Asked("ab", AB)
    project.probing.drain(without=(), now_s=0.0)
    probes = both((2, 1), (1, 1), is_startable=True)
    project.answer(0.5, a=probes["a"])
    assert project.probing.what_is_left(1.0) == ["b does not answer"]
    project.answer(1.0, b=probes["b"])
    left = ["a packet is under way on `a.o -> b.x`", "b has a packet to work on"]
    assert project.probing.what_is_left(1.0) == left
    project.probing.check(2.0, 0.0)
    assert project.numbers == [1, 2]
    assert project.probing.what_is_left(2.01) == left, "the next answers are on their way"
    assert project.probing.what_is_left(3.0) == ["a does not answer", "b does not answer"]


# ------------------------------------------------------------------ the end of a step


def test_a_session_gets_times_and_packets_after_one_round_and_each_packet_once() -> None:
    step = Asked("ab")
    step.probing.await_rest(Advance(9, 2, {"a.x": 3, "a.y": 0}), 0.0)
    assert step.asked == [Probe(1, once_idle=True, known={"a.x": 3, "a.y": 0})]
    idle, not_begun = NodeProbe(sim_time=0.5), NodeProbe(is_active=False)
    verdict = step.answer(0.0, {"a.x": (4, [b"4"])}, a=idle, b=not_begun)
    assert verdict is Verdict.UNDECIDED
    step.probing.check(step.probing.due_s, 0.0)
    assert step.asked[-1] == Probe(2, once_idle=True, known={"a.x": 4, "a.y": 0})
    assert step.answer(1.0, {"a.x": (5, [b"5"])}, a=idle, b=NodeProbe()) is Verdict.AT_REST
    assert step.probing.end_rest() == AtRest(9, {"a": 0.5}, {"a.x": (5, [b"4", b"5"])})
    assert step.probing.verdict is Verdict.UNDECIDED


def test_processes_that_have_not_connected_are_waited_for() -> None:
    step = Asked("ab")
    step.are_there = False
    step.probing.await_rest(Advance(1, 0, {}), 0.0)
    assert not step.asked
    step.are_there = True
    step.probing.check(step.probing.due_s, 0.0)
    assert step.answer(1.0, a=NodeProbe(), b=NodeProbe()) is Verdict.AT_REST


def test_packets_of_a_lossy_connection_are_given_up_after_a_while() -> None:
    step, now_s = Asked("ab", LOSSY), 0.0
    step.probing.await_rest(Advance(1, 0, {}), now_s)
    while step.answer(now_s, **both((3, 0), (2, 0), LOSSY)) is Verdict.UNDECIDED:
        now_s = step.probing.due_s
        step.probing.check(now_s, 0.0)
    assert 0.1 <= now_s < 0.2


def test_who_lets_the_run_go_on_is_answered_no_more_nor_who_asks_while_it_drains() -> None:
    step = Asked("a")
    step.probing.await_rest(Advance(1, 0, {}), 0.0)
    step.probing.end_rest()
    assert step.answer(0.0, a=NodeProbe()) is Verdict.UNDECIDED
    step.probing.drain(without=(), now_s=1.0)
    step.probing.await_rest(Advance(2, 0, {}), 1.0)
    assert step.answer(1.0, a=NodeProbe()) is Verdict.UNDECIDED
    step.probing.check(2.0, 0.0)
    assert step.answer(2.0, a=NodeProbe()) is Verdict.DRAINED
