"""The judge can fail: logs that are right pass, and each way of being wrong is refused by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest

from .description import Connection, Hook, Node, Port, Project, Sent, Taken
from .judge import MS, Judge, judge
from .running import Execution, Observed

INT = Port("int")
Packet = tuple[str, int]


class Story:
    """A run that is made up: executions in milliseconds, and the books that would fit to them."""

    def __init__(self, project: Project, backend: str = "process") -> None:
        self.project = project
        self.seen = Observed(backend, ended_ns=0, ending_ns=1000 * MS)
        self.seen.executions = {node.name: [] for node in project.nodes}
        self.seen.loaded_ns = {node.name: -100 * MS for node in project.nodes}
        self.numbers: dict[str, int] = {}
        self.exit_code, self.reason = 0, "1 s are over"
        self.books: dict[str, dict[str, Any]] = {}

    def run(
        self, name: str, at_ms: float, *taken: Sequence[Packet | None] | None, ms: float = 1
    ) -> Story:
        """A hook ``node.hook`` runs; it sends on all its outputs."""
        node, hook = name.split(".")
        outputs = next(h for h in self.project.by_name[node].hooks if h.name == hook).outputs
        sent = {}
        for each in outputs:
            origin = f"{node}.{each.port}"
            sent[each.port] = self.numbers[origin] = self.numbers.get(origin, 0) + 1
        packets = [
            None if each is None else [None if p is None else self._packet(*p) for p in each]
            for each in taken
        ]
        start_ns, end_ns = int(at_ms * MS), int((at_ms + ms) * MS)
        execution = Execution(node, hook, start_ns, end_ns, packets, sent)
        self.seen.executions[node].append(execution)
        return self

    def _packet(self, origin: str, number: int) -> tuple[int, int, bool]:
        return self.project.origins.index(origin), number, True

    def book(self, connection: str, **counts: int) -> None:
        """``run.json`` says something else of a connection."""
        self.books[connection] = counts

    def rules(self) -> set[str]:
        """Which rules the judge finds broken."""
        self.close()
        return {each.rule for each in judge(self.project, self.seen)}

    def close(self) -> Observed:
        """The run ends, and its books are written."""
        for log in self.seen.executions.values():
            log.sort(key=lambda each: each.start_ns)
        for node in self.project.nodes:  # those who end last
            for hook in node.hooks:
                if hook.kind == "finalise" and not self._ran(node.name, hook.name):
                    self.run(f"{node.name}.{hook.name}", 1100)
        self.seen.ended_ns = self.seen.ended_ns or 1300 * MS
        self.seen.record = {
            "exit_code": self.exit_code,
            "reason": self.reason,
            "nodes": {
                node.name: {
                    "hooks": {
                        hook.name: {
                            "executions": self._ran(node.name, hook.name),
                            "missed_ticks": 0,
                        }
                        for hook in node.hooks
                    }
                }
                for node in self.project.nodes
            },
            "connections": [self._counted(c) for c in self.project.connections],
        }
        return self.seen

    def _ran(self, node: str, hook: str) -> int:
        return sum(each.hook == hook for each in self.seen.executions[node])

    def _counted(self, c: Connection) -> dict[str, Any]:
        origin = self.project.origins.index(c.origin)
        node = self.project.by_name[c.destination_node]
        taken = [
            {
                packet[1]
                for each in self.seen.executions[node.name]
                if each.hook == hook.name
                for packets in each.taken
                for packet in packets or ()
                if packet is not None and packet[0] == origin
            }
            for hook in node.takers(c.destination_input)
        ]
        sent = self.numbers.get(c.origin, 0)
        consumed = set.intersection(*taken) if taken else set(range(sent))
        passed = min((max(each, default=0) for each in taken), default=sent)
        gone = passed - len([number for number in consumed if number <= passed])
        counts = {
            "connection": str(c),
            "sent": sent,
            "received": sent,
            "in_flight": 0,
            "lost": 0,
            "consumed": len(consumed),
            "discarded": gone,
            "unread": sent - len(consumed) - gone,
            "longest_discard": min(gone, c.discard_limit or 0),
        }
        return {**counts, **self.books.get(str(c), {})}


# ------------------------------------------------------------------ one sender, one receiver


def pair(limit: int | None, queue_size: int = 1, *hooks: Hook) -> Project:
    sender = Hook("send", "tick", (), (Sent("o"),), seconds=0.02)
    taker = Hook("take", inputs=(Taken("x"),))
    nodes = (
        Node("a", (sender,), {}, {"o": INT}),
        Node("b", (taker, *hooks, Hook("end", "finalise")), {"x": INT}, {}),
    )
    return Project(nodes, (Connection("a", "o", "b", "x", limit, queue_size),), "duration", 1.0)


def told(limit: int | None, taken: Sequence[tuple[int, float]], *hooks: Hook) -> Story:
    """``a`` sends every 20 ms, ``b`` takes packets at these times."""
    story = Story(pair(limit, 1, *hooks))
    for number in range(50):
        story.run("a.send", number * 20)
    for number, at_ms in taken:
        story.run("b.take", at_ms, [("a.o", number)])
    return story


PROMPT = [(number, number * 20 - 18) for number in range(1, 51)]


@pytest.mark.parametrize("limit", [0, 3, None])
def test_a_run_that_is_right_breaks_no_rule(limit):
    assert told(limit, PROMPT).rules() == set()


def test_a_packet_skipped_on_a_lossless_connection():
    assert told(0, [p for p in PROMPT if p[0] != 20]).rules() >= {"gap"}


def test_more_packets_skipped_in_a_row_than_the_limit_says():
    for limit, last, is_wrong in ((3, 22, False), (3, 23, True), (None, 23, False)):
        taken = [p for p in PROMPT if p[0] not in range(20, last + 1)]
        assert ("gap" in told(limit, taken).rules()) is is_wrong


def test_packets_out_of_order_or_twice():
    swapped = [*PROMPT[:19], (21, 402), (20, 422), *PROMPT[21:]]
    assert "order" in told(None, swapped).rules()
    assert "order" in told(0, [*PROMPT[:20], (20, 402), *PROMPT[21:]]).rules()


def test_a_packet_that_had_not_been_sent_yet():
    assert told(None, [*PROMPT[:20], (22, 402), *PROMPT[22:]]).rules() >= {"content"}


def test_a_packet_that_is_not_as_it_was_sent():
    story = told(0, PROMPT)
    log = story.seen.executions["b"]
    log[7] = replace(log[7], taken=[[(0, 8, False)]])
    assert "content" in story.rules()


def test_a_stale_packet():
    """Six packets behind, though nothing keeps the hook from the newest."""
    late = [(number, number * 20 + 120) for number in range(1, 40)]
    assert {"fresh", "age"} <= told(None, late).rules()
    assert "fresh" in told(8, late).rules()


def test_a_limit_that_only_makes_a_longer_queue():
    slow = [(number, number * 100 + 2) for number in range(1, 10)]
    assert "fresh" in told(3, slow).rules()


def test_a_node_that_sleeps_though_a_packet_is_there():
    rested = [*PROMPT[:20], *((n, at) for n, at in PROMPT if n > 35)]
    assert "awake" in told(None, rested).rules()
    assert "awake" in told(None, PROMPT[:20]).rules()


def test_hooks_that_overlap():
    story = told(0, PROMPT)
    log = story.seen.executions["b"]
    log[3] = replace(log[3], end_ns=log[4].start_ns + 1)
    assert "single thread" in story.rules()


def test_in_process_hooks_of_different_nodes_must_not_overlap_either():
    story = told(0, PROMPT)
    story.seen.backend = "in-process"
    assert story.rules() == set()
    log = story.seen.executions["b"]
    log[3] = replace(log[3], end_ns=80 * MS + 1)
    assert "single thread" in story.rules()


# ------------------------------------------------------------------ windows, ticks, phases


def test_a_sender_that_ignores_its_window():
    """The receiver is at its first packet for 800 ms."""
    story = Story(pair(1))
    for number in range(40):
        story.run("a.send", number * 20)
    story.run("b.take", 2, [("a.o", 1)], ms=800)
    assert "window" in story.rules()


def test_a_sender_that_waits_for_the_acknowledgement_breaks_nothing():
    story = Story(pair(1))
    for at_ms in (0, 20, 820):
        story.run("a.send", at_ms)
    story.run("b.take", 2, [("a.o", 1)], ms=790)
    story.run("b.take", 793, [("a.o", 2)], ms=100)
    story.run("b.take", 894, [("a.o", 3)], ms=100)
    assert "window" not in story.rules()


def ticking(*starts_ms: float) -> Story:
    hooks = (Hook("first", "initialise"), Hook("tick", "tick", seconds=0.1))
    story = Story(Project((Node("a", hooks, {}, {}),), (), "duration", 1.0))
    story.run("a.first", 0, ms=10)
    for at_ms in starts_ms:
        story.run("a.tick", at_ms)
    return story


def test_ticks_on_time():
    assert ticking(*(10 + 100 * k for k in range(1, 11))).rules() == set()


def test_a_tick_before_its_first_due_time():
    assert "tick" in ticking(60, *(10 + 100 * k for k in range(1, 11))).rules()


def test_ticks_that_come_too_often():
    assert "tick" in ticking(*(10 + 70 * k for k in range(2, 14))).rules()


def test_ticks_that_drift():
    """Each is counted from the last one, which was 30 ms late, and none as missed."""
    assert "tick" in ticking(*(10 + 130 * k for k in range(1, 15))).rules()


def test_initialise_hooks_that_run_late_or_twice():
    for at_ms in (50, 250):
        story = ticking(*(10 + 100 * k for k in range(1, 11)))
        assert "initialise" in story.run("a.first", at_ms).rules()


def started(at_ms: float, *, begins: Sequence[Packet] | None = None) -> Story:
    """``b`` loads for 100 ms and initialises for 50 ms, then ``a`` sends its first packet.

    ``begins``: what the initialise hook of ``b`` takes, if it takes packets.
    """
    inputs = () if begins is None else (Taken("x"),)
    story = Story(pair(0, 1, Hook("first", "initialise", inputs)))
    story.seen.loaded_ns["b"] = 100 * MS
    story.run("a.send", at_ms)
    story.run("b.first", 101, *[begins] * len(inputs), ms=50)
    story.run("b.take", max(at_ms, 151) + 2, [("a.o", 1)])
    story.seen.ending_ns = 153 * MS
    return story


def test_hooks_that_run_before_the_initialise_hooks_of_every_node_have_ended():
    assert "start" in started(150).rules()
    assert "start" not in started(172).rules()


def test_initialise_hooks_that_run_before_every_plugin_is_loaded():
    story = started(172)
    story.seen.loaded_ns["a"] = 102 * MS
    assert "start" in story.rules()


def test_hooks_that_send_what_an_initialise_hook_waits_for_need_not_wait_for_its_end():
    assert "start" not in started(120, begins=[("a.o", 1)]).rules()
    assert "start" in started(99, begins=[("a.o", 1)]).rules()


def test_a_node_that_was_never_let_begin_in_a_run_that_ended_well():
    story = started(172)
    story.close()
    story.seen.executions["b"].clear()
    assert "finalise" in {each.rule for each in judge(story.project, story.seen)}


def test_finalise_hooks_that_run_twice_or_never():
    assert "finalise" in told(0, PROMPT).run("b.end", 1100).run("b.end", 1150).rules()
    story = told(0, PROMPT)
    story.close()
    story.seen.executions["b"].pop()
    assert "finalise" in {each.rule for each in judge(story.project, story.seen)}


# ------------------------------------------------------------------ several inputs


def vote(*, is_all: bool, is_optional: bool, limit: int | None = 0) -> Story:
    """``a`` and ``b`` send to ``c``, whose first connection is that of ``b``."""
    sender = Hook("send", "tick", (), (Sent("o"),), seconds=0.1)
    count = Hook("count", inputs=(Taken("x", is_all, is_optional),))
    nodes = (
        Node("a", (sender,), {}, {"o": INT}),
        Node("b", (sender,), {}, {"o": INT}),
        Node("c", (count,), {"x": INT}, {}),
    )
    connections = tuple(Connection(name, "o", "c", "x", limit, 2) for name in ("b", "a"))
    story = Story(Project(nodes, connections, "duration", 1.0))
    story.seen.ending_ns = 1 * MS  # what happens after the last line is of no interest here
    return story


def test_the_packets_of_an_all_input_in_the_order_of_the_project():
    story = vote(is_all=True, is_optional=False).run("a.send", 0).run("b.send", 0)
    assert story.run("c.count", 10, [("b.o", 1), ("a.o", 1)]).rules() == set()
    story = vote(is_all=True, is_optional=False).run("a.send", 0).run("b.send", 0)
    assert "input" in story.run("c.count", 10, [("a.o", 1), ("b.o", 1)]).rules()


def test_an_all_input_with_a_packet_missing():
    story = vote(is_all=True, is_optional=False).run("a.send", 0)
    assert "input" in story.run("c.count", 10, [None, ("a.o", 1)]).rules()


def test_a_required_input_without_a_packet():
    story = vote(is_all=False, is_optional=False).run("a.send", 0)
    assert "input" in story.run("c.count", 10, None).rules()


def test_a_packet_that_has_waited_longer_and_is_left():
    story = vote(is_all=False, is_optional=False).run("a.send", 0).run("b.send", 300)
    story.run("c.count", 0, [("a.o", 1)])
    story = vote(is_all=False, is_optional=False).run("b.send", 0).run("c.count", 2, [("b.o", 1)])
    story.run("a.send", 100).run("b.send", 400)
    assert "oldest first" in story.run("c.count", 500, [("b.o", 2)]).rules()


@pytest.mark.parametrize("is_all", [True, False])
def test_an_optional_input_that_is_left_empty_though_a_packet_is_there(is_all):
    story = vote(is_all=is_all, is_optional=True).run("a.send", 0)
    nothing = [None, None] if is_all else None
    assert story.run("c.count", 20, nothing).rules() == set()
    assert "optional" in story.run("c.count", 300, nothing).rules()


def test_a_packet_of_somebody_who_does_not_feed_the_input():
    stranger = Node("z", (Hook("send", "tick", (), (Sent("o"),), seconds=1.0),), {}, {"o": INT})
    project = pair(0)
    story = Story(replace(project, nodes=(*project.nodes, stranger)))
    story.run("z.send", 0).run("b.take", 10, [("z.o", 1)])
    assert "content" in story.rules()


# ------------------------------------------------------------------ fairness


def overloaded(obeyed_ms: float) -> Story:
    """``watch`` takes 100 ms for each packet of ``a``; a command is there from 310 ms on."""
    hooks = (Hook("watch", inputs=(Taken("x"),)), Hook("obey", inputs=(Taken("y"),)))
    fast = Hook("send", "tick", (), (Sent("o"),), seconds=0.02)
    slow = Hook("send", "tick", (), (Sent("o"),), seconds=0.3)
    nodes = (
        Node("a", (fast,), {}, {"o": INT}),
        Node("c", (slow,), {}, {"o": INT}),
        Node("b", hooks, {"x": INT, "y": INT}, {}),
    )
    connections = (Connection("a", "o", "b", "x"), Connection("c", "o", "b", "y", 0))
    story = Story(Project(nodes, connections, "duration", 1.0))
    for number in range(50):
        story.run("a.send", number * 20)
    story.run("c.send", 310)
    for place in range(10):
        at_ms = 2 + place * 101
        newest = int(at_ms) // 20 + 1
        story.run("b.watch", at_ms, [("a.o", newest)], ms=100)
    story.run("b.obey", obeyed_ms, [("c.o", 1)], ms=0.5)
    return story


def test_a_hook_that_is_starved_by_a_faster_input():
    assert "fair" not in overloaded(406.2).rules()
    assert {"fair", "age"} <= overloaded(911.2).rules()


# ------------------------------------------------------------------ the books, the end


@pytest.mark.parametrize(
    "counts",
    [
        {"sent": 51},
        {"received": 49},
        {"consumed": 49, "unread": 1},
        {"received": 49, "lost": 1, "consumed": 49},
        {"received": 49, "in_flight": 1, "consumed": 49},
        {"discarded": 1, "consumed": 49},
    ],
)
def test_books_that_do_not_close_or_say_something_else(counts):
    story = told(0, PROMPT)
    story.book("a.o -> b.x", **counts)
    assert story.rules() == {"counts"}


def test_executions_that_were_counted_wrongly():
    story = told(0, PROMPT)
    story.close()
    story.seen.record["nodes"]["b"]["hooks"]["take"]["executions"] += 1
    assert {each.rule for each in judge(story.project, story.seen)} == {"counts"}


def _failed(story: Story) -> None:
    story.exit_code, story.reason = 1, "b failed"


def _slow(story: Story) -> None:
    story.seen.ended_ns = 30_000 * MS


def _left(story: Story) -> None:
    story.seen.left.append("process 1: python")


def _overdue(story: Story) -> None:
    story.seen.is_overdue = True


def _dead(story: Story) -> None:
    story.exit_code, story.reason = 1, "deadlock: nothing can ever run again"
    story.seen.ending_ns = None


@pytest.mark.parametrize(
    ("happens", "rule"),
    [(_failed, "end"), (_slow, "end"), (_left, "end"), (_overdue, "end"), (_dead, "awake")],
)
def test_an_end_that_is_wrong(happens: Callable[[Story], None], rule: str):
    story = told(0, PROMPT)
    happens(story)
    assert rule in story.rules()


def test_a_tick_long_after_the_end_was_asked_for():
    assert "drain" in told(0, PROMPT).run("a.send", 2500).rules()


def test_hooks_of_a_node_that_has_ended_the_project():
    hook = Hook("take", inputs=(Taken("x"),), shutdown_at=10)
    project = pair(0)
    b = replace(project.by_name["b"], hooks=(hook,))
    story = Story(replace(project, nodes=(project.nodes[0], b)))
    for number in range(11):
        story.run("a.send", number * 20)
    for number, at_ms in PROMPT[:10]:
        story.run("b.take", at_ms, [("a.o", number)])
    assert story.rules() == set()
    assert story.run("b.take", 202, [("a.o", 11)]).rules() == {"drain"}


def ring() -> Story:
    """Each waits for the other, and nothing was ever sent first: dead after one packet."""
    step = Hook("step", inputs=(Taken("x", False, True),), outputs=(Sent("o"),))
    control = Hook("control", inputs=(Taken("x"),), outputs=(Sent("o"),))
    nodes = (
        Node("step", (step,), {"x": INT}, {"o": INT}),
        Node("control", (control,), {"x": INT}, {"o": INT}),
    )
    connections = (
        Connection("step", "o", "control", "x", 0),
        Connection("control", "o", "step", "x", 0),
    )
    story = Story(Project(nodes, connections, "duration", 9.0))
    story.run("step.step", 0, None).run("control.control", 2, [("step.o", 1)])
    story.run("step.step", 4, None)  # what control sent is still on its way
    story.seen.ending_ns, story.seen.ended_ns = None, 3000 * MS
    story.exit_code, story.reason = 1, "deadlock: nothing can ever run again"
    return story


def test_a_deadlock_that_is_one():
    assert ring().rules() == set()
    story = ring()
    assert Judge(story.project, story.close()).is_dead


def test_a_deadlock_of_which_nobody_speaks():
    story = ring()
    story.seen.ending_ns, story.seen.ended_ns = 9000 * MS, 9200 * MS
    story.exit_code, story.reason = 0, "9 s are over"
    assert story.rules() == {"end"}
