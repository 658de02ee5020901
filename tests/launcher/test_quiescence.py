"""Drained, dead, and who waits for whom: judged from the probes of all nodes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuros.control import Message, Probe, Probed
from neuros.launcher.quiescence import (
    Probing,
    Verdict,
    counters,
    cycle,
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


def probe(node: str = "a", number: int = 0, **changes: Any) -> Probed:
    """A probe of a node that waits for nothing, without connections."""
    metrics = {"outgoing": {}, "incoming": {}, "hooks": {}, "state": {"state": "idle", "cause": ""}}
    answer: dict[str, Any] = {
        "metrics": metrics | changes.pop("metrics", {}),
        "is_startable": False,
        "is_wakeable": False,
        "is_idle": True,
        **changes,
    }
    return Probed(node=node, number=number, **answer)


def metrics_of(answer: Probed) -> Any:
    """To be changed."""
    return answer.metrics


def sender(connection: Connection, sent: int, acknowledged: int, **changes: Any) -> Probed:
    book = {
        "sent": sent,
        "acknowledged": acknowledged,
        "outstanding": sent - acknowledged,
        "is_blocked": sent - acknowledged >= connection.window,
    }
    return probe(connection.source_node, metrics={"outgoing": {str(connection): book}}, **changes)


def receiver(connection: Connection, received: int, acknowledged: int, **changes: Any) -> Probed:
    book = {"received": received, "acknowledged": acknowledged}
    return probe(
        connection.destination_node, metrics={"incoming": {str(connection): book}}, **changes
    )


# ------------------------------------------------------------------ drained


def test_a_project_is_drained_when_all_packets_and_acknowledgements_have_arrived() -> None:
    probes = {"a": sender(AB, 3, 3), "b": receiver(AB, 3, 3)}
    assert is_drained(probes, [AB])
    assert under_way(probes, [AB]) == []


@pytest.mark.parametrize(
    ("at_a", "at_b"), [((3, 2), (2, 2)), ((3, 2), (3, 3))], ids=["a packet", "an acknowledgement"]
)
def test_what_is_under_way_is_named(at_a: tuple[int, int], at_b: tuple[int, int]) -> None:
    probes = {"a": sender(AB, *at_a), "b": receiver(AB, *at_b)}
    assert not is_drained(probes, [AB])
    assert under_way(probes, [AB]) == ["a.o -> b.x"]


def test_a_packet_that_a_hook_could_start_on_has_to_be_worked_on_first() -> None:
    probes = {"a": sender(AB, 3, 2), "b": receiver(AB, 3, 2, is_startable=True)}
    assert not is_drained(probes, [AB])


def test_a_packet_that_no_hook_can_start_on_does_not_hold_up_the_end() -> None:
    assert is_drained({"a": sender(AB, 3, 2), "b": receiver(AB, 3, 2)}, [AB])


def test_packets_that_may_be_lost_do_not_hold_up_the_end() -> None:
    probes = {"a": sender(LOSSY, 9, 0, is_idle=False), "b": receiver(LOSSY, 4, 0, is_idle=False)}
    assert is_drained(probes, [LOSSY])
    assert reliable_counters(probes, [LOSSY]) == ()


def test_in_virtual_time_they_do_since_they_arrive_at_the_same_time_in_every_run() -> None:
    probes = {
        "a": sender(LOSSY, 9, 0, is_idle=False, virtual_s=0.5),
        "b": receiver(LOSSY, 4, 0, virtual_s=0.5),
    }
    assert not is_drained(probes, [LOSSY])
    probes["a"] = sender(LOSSY, 9, 0, virtual_s=0.5)
    assert is_drained(probes, [LOSSY])


def test_connections_to_nodes_that_never_began_do_not_count() -> None:
    assert is_drained({"a": sender(AB, 0, 0)}, [AB])


# ------------------------------------------------------------------ dead


def test_a_project_is_dead_when_nothing_can_wake_any_node() -> None:
    assert is_dead({"a": sender(AB, 1, 0), "b": receiver(AB, 1, 0)}, [AB])


@pytest.mark.parametrize("change", [{"is_wakeable": True}, {"is_idle": False}], ids=str)
def test_one_node_that_could_still_do_something_is_enough(change: dict[str, bool]) -> None:
    assert not is_dead({"a": sender(AB, 1, 0), "b": receiver(AB, 1, 0, **change)}, [AB])


def test_a_packet_under_way_could_wake_its_receiver() -> None:
    assert not is_dead({"a": sender(AB, 1, 0), "b": receiver(AB, 0, 0)}, [AB])


def test_every_count_tells_whether_something_has_happened() -> None:
    before = counters({"a": sender(AB, 1, 0), "b": receiver(AB, 1, 0)})
    assert before == counters({"b": receiver(AB, 1, 0), "a": sender(AB, 1, 0)})
    assert before != counters({"a": sender(AB, 1, 1), "b": receiver(AB, 1, 0)})
    assert before != counters({"a": sender(AB, 1, 0), "b": receiver(AB, 1, 1)})
    busier = sender(AB, 1, 0)
    metrics_of(busier)["hooks"] = {"step": {"executions": 1}}
    assert before != counters({"a": busier, "b": receiver(AB, 1, 0)})


# ------------------------------------------------------------------ who waits for whom


def test_a_ring_of_full_connections_is_named_with_its_connections() -> None:
    a, b = sender(AB, 1, 0), sender(BA, 1, 0)
    metrics_of(a)["incoming"][str(BA)] = {"received": 1, "acknowledged": 0}
    metrics_of(b)["incoming"][str(AB)] = {"received": 1, "acknowledged": 0}
    assert cycle(waits({"a": a, "b": b}, [AB, BA])) == [
        ("a", "is blocked on `a.o -> b.x` (1 outstanding)"),
        ("b", "is blocked on `b.o -> a.x` (1 outstanding)"),
    ]


def test_a_ring_of_missing_inputs_is_named_with_the_inputs() -> None:
    a, b = sender(AB, 0, 0), sender(BA, 0, 0)
    for node, source in ((a, BA), (b, AB)):
        metrics_of(node)["incoming"][str(source)] = {"received": 0, "acknowledged": 0, "unread": 0}
        metrics_of(node)["state"] = {"state": "waiting", "cause": "x"}
    assert cycle(waits({"a": a, "b": b}, [AB, BA])) == [
        ("a", "waits for `x` from b"),
        ("b", "waits for `x` from a"),
    ]


def test_who_has_delivered_is_not_waited_for_nor_a_packet_to_itself() -> None:
    """a takes all of b and c, and its own; only c's is missing, and c is blocked on b."""
    own, from_b, from_c = wire("a.o -> a.own"), wire("b.o -> a.x", index=1), wire("c.o -> a.x")
    to_b, missing = wire("c.o -> b.y"), wire("a.o -> b.z")
    full = {"sent": 1, "acknowledged": 0, "outstanding": 1, "is_blocked": True}
    free = {"sent": 1, "acknowledged": 1, "outstanding": 0, "is_blocked": False}
    unread, none = {"unread": 1}, {"unread": 0}
    a = probe(
        metrics={
            "outgoing": {str(own): full, str(missing): free},
            "incoming": {str(own): unread, str(from_b): unread, str(from_c): none},
            "state": {"state": "waiting", "cause": "x"},
        }
    )
    b = probe(
        metrics={
            "outgoing": {str(from_b): full},
            "incoming": {str(to_b): unread, str(missing): none},
            "state": {"state": "waiting", "cause": "z"},
        }
    )
    c = probe(metrics={"outgoing": {str(from_c): free, str(to_b): full}})
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


@dataclass
class World:
    """Nodes a, b, c that pass packets on, in a network that delivers when the test says so."""

    connections: list[Connection]
    flights: deque[tuple[str, Connection, int]] = field(default_factory=deque)
    sent: dict[str, int] = field(default_factory=dict)
    received: dict[str, int] = field(default_factory=dict)
    taken: dict[str, int] = field(default_factory=dict)
    heard: dict[str, int] = field(default_factory=dict)

    def send(self, connection: Connection) -> None:
        key = str(connection)
        self.sent[key] = self.sent.get(key, 0) + 1
        self.flights.append(("packet", connection, 0))

    def deliver(self, index: int) -> None:
        """The next thing under way arrives; any connection, but in order on each."""
        kind, connection, position = self.flights[index % len(self.flights)]
        first = next(f for f in self.flights if f[:2] == (kind, connection))
        self.flights.remove(first)
        key, position = str(connection), first[2]
        if kind == "packet":
            self.received[key] = self.received.get(key, 0) + 1
        else:
            self.heard[key] = position

    def execute(self, index: int, passes_on: bool) -> None:
        """A node takes a packet, acknowledges it, and may send one on."""
        full = [c for c in self.connections if self.unread(c)]
        if full:
            connection = full[index % len(full)]
            key = str(connection)
            self.taken[key] = self.taken.get(key, 0) + 1
            self.flights.append(("acknowledgement", connection, self.taken[key]))
            for out in self.connections:
                if passes_on and out.source_node == connection.destination_node:
                    self.send(out)

    def unread(self, connection: Connection) -> int:
        key = str(connection)
        return self.received.get(key, 0) - self.taken.get(key, 0)

    def probe(self, name: str, number: int) -> Probed:
        outgoing, incoming = {}, {}
        is_startable = False
        for c in self.connections:
            key = str(c)
            if c.source_node == name:
                heard = self.heard.get(key, 0)
                outgoing[key] = {"sent": self.sent.get(key, 0), "acknowledged": heard}
            if c.destination_node == name:
                taken = self.taken.get(key, 0)
                incoming[key] = {"received": self.received.get(key, 0), "acknowledged": taken}
                is_startable |= self.unread(c) > 0
        metrics = {"outgoing": outgoing, "incoming": incoming}
        return probe(name, number, metrics=metrics, is_startable=is_startable)


def asked_into(asked: list[int]) -> Callable[[Message], None]:
    """Notes the numbers of probes."""

    def send(message: Message) -> None:
        assert isinstance(message, Probe)
        asked.append(message.number)

    return send


RING = [wire("a.o -> b.x"), wire("b.o -> c.x", index=1), wire("c.o -> a.x", index=2)]
STEPS = st.lists(
    st.tuples(st.sampled_from(["deliver", "execute", "pass on", "answer"]), st.integers(0, 2)),
    max_size=80,
)


@settings(max_examples=200)
@given(STEPS)
def test_two_equal_rounds_never_miss_what_is_under_way(steps: list[tuple[str, int]]) -> None:
    world = World(RING)
    asked: list[int] = []
    probing = Probing("abc", RING, asked_into(asked))
    world.send(RING[0])
    probing.drain(without=(), now_s=0.0)
    answered: set[str] = set()
    for now_s, (step, index) in enumerate(steps):
        if step == "deliver" and world.flights:
            world.deliver(index)
        elif step in ("execute", "pass on"):
            world.execute(index, passes_on=step == "pass on")
        elif step == "answer":
            name = "abc"[index]
            answered.add(name)
            probing.add(world.probe(name, asked[-1]))
        if len(answered) == 3:
            answered = set()
            if probing.check(now_s, 0.0) is Verdict.DRAINED:
                assert not world.flights
                assert not any(map(world.unread, RING))
                return


def test_a_project_that_rests_is_found_drained_after_two_rounds() -> None:
    asked: list[int] = []
    probing = Probing("ab", [AB], asked_into(asked))
    probing.drain(without=(), now_s=0.0)
    for now_s in (1.0, 2.0):
        probing.add(sender(AB, 3, 3, number=asked[-1]))
        probing.add(receiver(AB, 3, 3, number=asked[-1]))
        verdict = probing.check(now_s, 0.0)
    assert verdict is Verdict.DRAINED
    assert asked == [1, 2]


def test_answers_to_older_questions_do_not_count() -> None:
    asked: list[int] = []
    probing = Probing("a", [], asked_into(asked))
    probing.drain(without=(), now_s=0.0)
    probing.add(probe())
    probing.add(probe(number=asked[-1] - 1))
    probing.check(1.0, 0.0)
    assert asked == [1], "nobody has answered yet"


def test_without_a_node_that_ever_began_there_is_nothing_to_drain() -> None:
    probing = Probing("ab", [AB], lambda _: None)
    probing.drain(without="ab", now_s=0.0)
    assert probing.check(0.0, 0.0) is Verdict.DRAINED


def test_nobody_is_asked_while_something_moves() -> None:
    asked: list[int] = []
    probing = Probing("a", [], asked_into(asked))
    probing.check(10.0, 0.9)
    assert asked == []
    probing.check(11.0, 1.0)
    probing.check(11.1, 1.1)
    assert asked == [1], "and then not too often"


def test_the_longer_nothing_moves_the_more_rarely_nodes_are_asked_until_something_does() -> None:
    asked: list[float] = []
    now_s = 0.0
    probing = Probing("a", [], lambda _: asked.append(now_s))
    for tick in range(1, 600):
        now_s = tick / 10
        has_moved_s = 50.0 if now_s >= 50.0 else 0.0
        probing.check(now_s, now_s - has_moved_s)
        if asked and asked[-1] == now_s:
            probing.add(probe(number=len(asked), is_wakeable=True))
    assert asked[:5] == [1.0, 1.5, 2.5, 4.5, 6.5], "two soon, for a deadlock; then ever later"
    assert [at for at in asked if at >= 50.0][:3] == [51.0, 51.5, 52.5], "and soon again"


def test_a_deadlock_is_found_after_two_rounds_and_explained_with_its_cures() -> None:
    asked: list[int] = []
    probing = Probing("ab", [AB], asked_into(asked))
    for now_s in (10.0, 11.0):
        assert probing.check(now_s, now_s) is Verdict.UNDECIDED
        probing.add(sender(AB, 1, 0, number=asked[-1]))
        probing.add(receiver(AB, 1, 0, number=asked[-1]))
    assert probing.check(11.1, 11.1) is Verdict.DEAD
    text = probing.why_dead()
    assert "a is blocked on `a.o -> b.x` (1 outstanding)" in text
    assert "leave out discard_limit" in text


def test_where_there_is_no_loop_the_deadlock_names_the_node_that_has_nothing_left_to_run() -> None:
    asked: list[int] = []
    probing = Probing("ab", [AB], asked_into(asked))
    for now_s in (10.0, 11.0):
        probing.check(now_s, now_s)
        probing.add(sender(AB, 0, 0, number=asked[-1]))
        waits_for_x = receiver(AB, 0, 0, number=asked[-1])
        waits_for_x.metrics["state"].update(state="waiting", cause="x")
        waits_for_x.metrics["incoming"][str(AB)]["unread"] = 0
        probing.add(waits_for_x)
    assert probing.check(11.1, 11.1) is Verdict.DEAD
    text = probing.why_dead()
    assert "b waits for `x` from a. No hook of a is left to run: let one send" in text
    assert "loop" not in text


def test_a_project_that_has_no_hook_left_is_told_to_end() -> None:
    probing = Probing("ab", [AB], lambda _: None)
    probing.add(sender(AB, 0, 0, number=0))
    probing.add(receiver(AB, 0, 0, number=0))
    assert probing.why_dead() == (
        "deadlock: nothing can ever run again: no hook can run. If the work is done, let a hook"
        " call node.shutdown"
    )


def test_what_is_left_names_who_is_busy_or_where_packets_are() -> None:
    asked: list[int] = []
    probing = Probing("ab", [AB], asked_into(asked))
    probing.drain(without=(), now_s=0.0)
    probing.add(sender(AB, 2, 1, number=1))
    assert probing.what_is_left(1.0) == ["b does not answer"]
    probing.add(receiver(AB, 1, 1, is_startable=True, number=1))
    left = ["a packet is under way on `a.o -> b.x`", "b has a packet to work on"]
    assert probing.what_is_left(1.0) == left
    probing.check(2.0, 0.0)
    assert asked == [1, 2]
    assert probing.what_is_left(2.01) == left, "the next answers are on their way"
    assert probing.what_is_left(3.0) == ["a does not answer", "b does not answer"]
