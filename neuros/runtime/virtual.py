"""The local runtime in virtual time: a discrete-event simulation of the nodes of a process.

Each node has a clock and a queue of events of its own (:class:`NodeTime`). A hook that starts at t
moves the clock of its node on by its duration before it returns, so that the engine, which knows
nothing of all this, sends at the end of the hook. What arrives meanwhile waits in the queue. The
node whose next event is earliest goes on (:class:`VirtualLoop`). Since every delay is at least
1 microsecond, nothing can arrive any more at the instant that a node handles, and events of several
nodes at one instant are independent.

At one instant a node handles arrivals (by connection in the project's order, then by number), its
packets to itself, what its simulator sends, and ticks; then hooks start.
"""

from __future__ import annotations

import queue
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from heapq import heapify, heappop, heappush
from typing import Any

from neuros.engine.horizon import END_NS
from neuros.ports import Transport
from neuros.project.model import Connection, NodeFile
from neuros.project.timing import LEAST_DELAY_NS, Draws, seed_of
from neuros.runtime.local import Event, LocalLoop, LocalMiddleware
from neuros.transport.memory import MemoryHub, MemoryLink, MemoryTransport

_CONTROL, _ARRIVAL, _OWN, _SIMULATOR, _LOOP_BACK = range(5)
"""The events of a node at one instant, in this order."""
DRAIN_S = 5.0


class NodeTime:
    """The clock and the events of one node (:class:`neuros.ports.NodeLoop`).

    Attributes:
        now_ns: the time of the node: that of the instant which it handles, or the end of its hook.
        instant_ns: the time of the last instant. While ``now_ns`` is later, a hook holds the node.
        starts: how many hooks have started at ``now_ns``.
        must_look: whether more may arrive up to ``now_ns`` than was known before the last event.
    """

    waits_for = ""
    must_look = False

    def __init__(self, loop: VirtualLoop, name: str, place: int) -> None:
        self._loop = loop
        self._name = name
        self._place = place
        self._events: list[tuple[int, int, int, int, Event]] = []
        self._count = 0
        self._lost: Counter[Connection] = Counter()
        self._timers: list[tuple[Callable[[], int | None], Event]] = []
        self.queued_ns: int | None = None
        self.now_ns = self.instant_ns = 0
        self.starts = 0
        self.post_from_thread = loop.post_from_thread

    # ------------------------------------------------------------------ for the engine

    def clock(self) -> int:
        """The time of the node."""
        return self.now_ns

    def has_taken_in(self) -> bool:
        """Whether a hook may start: nothing is left to arrive up to the time of the node."""
        if self.now_ns != self.instant_ns:
            return False
        events = self._events
        return not events or events[0][0] > self.now_ns or events[0][1] == _LOOP_BACK

    def post(self, event: Event) -> None:
        """Handle an event of the node itself at its time, after all arrivals."""
        self._add(self.now_ns, _OWN, event)

    def post_loop_back(self, event: Event) -> None:
        self._add(self.now_ns, _LOOP_BACK, event)

    def add_timer(self, next_due_ns: Callable[[], int | None], on_due: Event) -> None:
        self._timers.append((next_due_ns, on_due))

    def announce(self, duration_ns: int) -> None:
        """A hook starts that takes at least so long: who waits for the node may go on."""

    def watch(self, awaited: Callable[[], Sequence[Connection]]) -> None:
        """``awaited``: connections whose acknowledgements could change which hooks start."""

    def ready(self) -> None:
        """The initialise hooks have run, but for those that wait for packets."""

    def at_zero(self, event: Event, first_pass: Event) -> None:
        """Handle an event when time 0 of the run has come, which is now; then let hooks start."""
        event()
        self.post(first_pass)

    def hold(self, duration_ns: int) -> None:
        """A hook that started now takes so long."""
        self.now_ns += duration_ns
        self.starts = 0 if duration_ns else self.starts + 1
        if duration_ns and any(each[1] == _LOOP_BACK for each in self._events):
            # A loop-back comes after what arrives while the hook holds the node.
            self._events = [
                (self.now_ns, *each[1:]) if each[1] == _LOOP_BACK else each for each in self._events
            ]
            heapify(self._events)

    # ------------------------------------------------------------------ for others

    @property
    def zero_ns(self) -> int:
        """Time 0 of the run, on the clock of the node; before it, now."""
        return self._loop.zero_ns if self._loop.has_begun else self.now_ns

    @property
    def seed(self) -> str:
        """That of the run."""
        return self._loop.seed

    def begin(self) -> None:
        """Time 0 of the run has come."""
        self._loop.begin()

    def end(self, drain_s: float, tell: Event) -> None:
        """The node asks for the end of the run now; ``tell``, if nobody has asked before."""
        self._loop.end(self._name, drain_s, tell)

    def drain(self, event: Event, stop: Event, *, is_asked: bool) -> None:
        """Handle an event when the end of the run reaches the node, before everything else."""
        self._add(max(self._loop.drain(self._name, stop), self.now_ns), _CONTROL, event)

    def at(self, time_ns: int, event: Event) -> None:
        """Handle an event of the node's simulator at a time, or now if that has passed."""
        self._add(max(time_ns, self.now_ns), _SIMULATOR, event)

    def arrive(self, time_ns: int, index: int, number: int, event: Event) -> None:
        """Handle an arrival on the connection of this index at a time."""
        heappush(self._events, (time_ns, _ARRIVAL, index, number, event))
        self._loop.queue(self, self._place)

    def after(self, duration_ns: int, event: Event) -> None:
        """Handle an event so long from now, before everything else at that instant."""
        self._add(self.now_ns + duration_ns, _CONTROL, event)

    def lose(self, connection: Connection) -> None:
        """Count a packet of the node that will be lost."""
        self._lost[connection] += 1

    def lost(self, connection: Connection) -> int:
        """How many were, on a connection."""
        return self._lost[connection]

    # ------------------------------------------------------------------ for the loop

    @property
    def next_ns(self) -> int | None:
        """The time of the next event of the node, not before its own time; ``None``: never."""
        first_ns = self._events[0][0] if self._events else None
        for next_due_ns, _ in self._timers:
            due_ns = next_due_ns()
            if due_ns is not None and (first_ns is None or due_ns < first_ns):
                first_ns = due_ns
        return self.now_ns if first_ns is not None and first_ns < self.now_ns else first_ns

    def step(self, time_ns: int) -> None:
        """Handle the events of an instant, until a hook takes time."""
        self.wait_until(time_ns)
        events = self._events
        while events and events[0][0] <= time_ns:
            heappop(events)[-1]()
            if self.now_ns != time_ns or self.must_look:
                return
        for next_due_ns, on_due in self._timers:
            due_ns = next_due_ns()
            if due_ns is not None and due_ns <= time_ns and self.now_ns == time_ns:
                on_due()

    def wait_until(self, time_ns: int) -> None:
        """Let time pass up to an instant, unless a hook holds the node for longer."""
        if time_ns > self.now_ns:
            self.now_ns, self.starts = time_ns, 0
        if time_ns == self.now_ns:
            self.instant_ns = time_ns

    def take_in(self) -> bool:
        """Handle the arrivals that are under way, if any; no hook starts any more."""
        events, self._events = sorted(self._events, key=lambda each: each[:4]), []
        arrivals = [each[-1] for each in events if each[1] in (_ARRIVAL, _OWN)]
        for event in arrivals:
            event()
        return bool(arrivals)

    def _add(self, time_ns: int, kind: int, event: Event) -> None:
        self._count += 1
        heappush(self._events, (time_ns, kind, 0, self._count, event))
        self._loop.queue(self, self._place)


class VirtualLoop(LocalLoop):
    """Runs the nodes of a process in the order of their next events.

    What the program or the launcher asks for comes between two instants: before the nodes have
    begun, and once they drain, when no event is left.

    Args:
        seed: of durations, delays and losses.

    Attributes:
        now_ns: the latest instant of any node.
        zero_ns: time 0 of the run.
        has_begun: whether that has come.
        waits_for_rest: whether what is asked for comes only when no event is left.
        limit_ns: nothing happens from this time on, until it is ``None``.
    """

    def __init__(self, seed: str) -> None:
        super().__init__(lambda: self.now_ns)
        self._loop_backs: deque[Event] = deque()  # for when nothing is left to do, or may be
        self.post_loop_back = self._loop_backs.append
        self.seed = seed
        self._duration: tuple[int, Event] | None = None
        self._factor: float | None = None
        self._began_s = 0.0
        self._nodes: list[NodeTime] = []
        self._by_name: dict[str, NodeTime] = {}
        self._next: list[tuple[int, int]] = []
        self.now_ns = self.zero_ns = 0
        self.has_begun = False
        self.waits_for_rest = True
        self.limit_ns: int | None = None
        self._on_limit: list[Event] = []
        self._calls: list[tuple[int, Event]] = []
        self._end: tuple[int, str, int] | None = None  # time, node that asked, time to drain
        self._tell_end: Event | None = None

    def of(self, name: str) -> NodeTime:
        """The clock and the events of a node; the first call tells its place among all nodes."""
        if name not in self._by_name:
            self._by_name[name] = self._make_node(name, len(self._nodes))
            self._nodes.append(self._by_name[name])
        return self._by_name[name]

    def _make_node(self, name: str, place: int) -> NodeTime:
        return NodeTime(self, name, place)

    def queue(self, node: NodeTime, place: int) -> None:
        """A node has a new event, or has handled one."""
        next_ns = node.next_ns
        if next_ns is not None and (node.queued_ns is None or next_ns < node.queued_ns):
            node.queued_ns = next_ns
            heappush(self._next, (next_ns, place))

    @property
    def has_waiting_events(self) -> bool:
        return bool(self._events) or self._next_node() is not None

    def begin(self) -> None:
        """Time 0 of the run has come: for each node, in one event."""
        if self.has_begun:
            return
        self.has_begun = True
        self.synchronise()
        self.zero_ns = self.now_ns
        self._began_s = time.monotonic()
        self.waits_for_rest = False
        if self._duration is not None:
            duration_ns, on_end = self._duration
            self.limit_ns, self._on_limit = self.zero_ns + duration_ns, [on_end]

    def begin_anew(self, seed: str) -> None:
        """The nodes are reset, at rest: this is time 0 again."""
        self.seed = seed
        self.synchronise()
        self.zero_ns = self.now_ns

    def synchronise(self) -> None:
        """Let time pass in all nodes up to the latest instant, so that they have one time."""
        if self._next_node() is None:
            self.now_ns = max(self.now_ns, *(node.now_ns for node in self._nodes), 0)
        for place, node in enumerate(self._nodes):
            node.wait_until(self.now_ns)
            self.queue(node, place)

    def rest(self, time_ns: int) -> None:
        """Nothing moves in the run any more: it is this time in all nodes."""
        self.now_ns = max(self.now_ns, time_ns)
        self.synchronise()

    def go_on(self, *, is_stepped: bool) -> None:
        """A pause ends, now in all nodes of the run; ``is_stepped``: until nothing moves."""

    def plan(self, duration_s: float | None, on_end: Event, real_time_factor: float | None) -> None:
        """Call ``on_end`` at the end of a duration from time 0; go no faster than the factor.

        Args:
            real_time_factor: seconds of virtual time per second of the machine, at most; ``None``:
                as fast as the machine allows.
        """
        self._duration = None if duration_s is None else (round(duration_s * 1e9), on_end)
        self._factor = real_time_factor

    def call_at(self, time_s: float, event: Event) -> None:
        """Call ``event`` so long after time 0, before anything else happens at that time."""
        self._calls.append((round(time_s * 1e9), event))

    def end(self, name: str, drain_s: float, tell: Event | None = None) -> None:
        """A node asks for the end, or nobody (``""``): what comes later than now waits.

        The end reaches the other nodes after :data:`neuros.engine.horizon.END_NS`. If several ask
        at one instant, the first by name does. ``tell`` is called when it is certain.
        """
        asked = self.now_ns, name, round(drain_s * 1e9)
        if self._end is None or asked < self._end:
            self._end, self._tell_end = asked, tell
            self.limit_ns, self._on_limit = self.now_ns + 1, []

    def drain(self, name: str, stop: Event) -> int:
        """When a node begins to drain; ``stop`` is called if the run has not drained in time."""
        if self._end is None:
            self.end("", DRAIN_S)
        assert self._end is not None
        end_ns, stopped, drain_ns = self._end
        self.waits_for_rest = True
        self.limit_ns = end_ns + drain_ns
        self._on_limit.append(stop)
        return end_ns + (END_NS if stopped not in ("", name) else 0)

    # ------------------------------------------------------------------ running

    def step(self) -> bool:
        """Handle what is asked for, or the next instant of a node; returns whether there was any.

        Raises:
            BaseException: the :attr:`interruption`; the events that wait are kept.
        """
        while not self._from_threads.empty():
            self._events.append(self._from_threads.get())
        if self.interruption is not None:
            self._raise_interruption()
        if self._is_stopping:
            return False
        if self._events and not (self.waits_for_rest and self._can_go_on()):
            self.synchronise()
            self._events.popleft()()
            for place, each in enumerate(self._nodes):
                self.queue(each, place)
            return True
        node = self._next_node()
        if (
            self._tell_end is not None
            and self._end is not None
            and (node is None or node.queued_ns is None or node.queued_ns > self._end[0])
        ):
            if not self._is_first(self._end[0]):
                return False
            tell, self._tell_end = self._tell_end, None
            tell()
            return True
        if node is None or node.queued_ns is None:
            return False
        time_ns, limit_ns = node.queued_ns, self.limit_ns
        if not self._may_handle(time_ns if limit_ns is None else min(time_ns, limit_ns)):
            return False
        if limit_ns is not None and time_ns >= limit_ns:
            return self._come_to_limit(limit_ns)
        if self._calls and not self.waits_for_rest and time_ns >= self.zero_ns + self._calls[0][0]:
            self._calls.pop(0)[1]()
            return True
        if self._factor is not None and not self._is_due(time_ns):
            return True
        _, place = heappop(self._next)
        node.queued_ns = None
        self.now_ns = max(self.now_ns, time_ns)
        node.step(time_ns)
        self.queue(node, place)
        return True

    def run_until_idle(self) -> None:
        while self.step():
            """Until no node has an event."""
        self.synchronise()

    def run(self) -> None:
        while not self._is_stopping:
            if not self.step() and not self._loop_back():
                self.wait(None)

    def take_in(self) -> None:
        is_moving = True
        while is_moving:  # an arrival may be answered by an acknowledgement
            is_moving = sum(node.take_in() for node in self._nodes) > 0

    def wait(self, seconds: float | None) -> None:
        try:
            self._events.append(self._from_threads.get(timeout=seconds))
        except queue.Empty:
            return

    def _loop_back(self) -> bool:
        """Handle events that waited until nothing is left to do; returns whether others follow."""
        for _ in range(len(self._loop_backs)):
            self._loop_backs.popleft()()
        return bool(self._events)

    def _may_handle(self, time_ns: int) -> bool:
        """Whether nothing can arrive any more before the events of a time."""
        return True

    def _is_first(self, time_ns: int) -> bool:
        """Whether no node can ask for an end at this time or before any more."""
        return True

    def _come_to_limit(self, limit_ns: int) -> bool:
        """Do what is to be done at the limit, once; returns whether there was anything."""
        events, self._on_limit = self._on_limit, []
        if events:
            self.now_ns = max(self.now_ns, limit_ns)
            self.synchronise()
            if self.waits_for_rest:  # hooks stop, and what is under way arrives
                self.limit_ns = None
            for event in events:
                event()
        return bool(events)

    def _can_go_on(self) -> bool:
        node = self._next_node()
        if node is None or node.queued_ns is None:
            return False
        return self.limit_ns is None or node.queued_ns < self.limit_ns or bool(self._on_limit)

    def _next_node(self) -> NodeTime | None:
        """The node whose event is next, with its time in ``queued_ns``."""
        while self._next:
            time_ns, place = self._next[0]
            node = self._nodes[place]
            if node.queued_ns != time_ns:
                heappop(self._next)  # an earlier one has taken its place
                continue
            next_ns = node.next_ns
            if next_ns == time_ns:
                return node
            heappop(self._next)
            node.queued_ns = None
            self.queue(node, place)
        return None

    def _is_due(self, time_ns: int) -> bool:
        """Whether an instant has come on the clock of the machine; waits for it, or for others."""
        assert self._factor is not None
        due_s = self._began_s + (time_ns - self.zero_ns) / 1e9 / self._factor
        early_s = due_s - time.monotonic()
        if early_s > 0:
            self.wait(early_s)
        return early_s <= 0


class OneWay:
    """One direction of a connection: when its packets, or its acknowledgements, arrive.

    Args:
        what: ``"delay"``, that of packets, or ``"acknowledgement"``.
    """

    __slots__ = ("_arrival_ns", "_delay", "_delays", "_loss", "_losses", "_number")

    def __init__(self, seed: str, what: str, connection: Connection) -> None:
        self._delay = connection.delay
        self._loss = connection.loss if what == "delay" else 0.0
        self._delays = Draws(seed, what, str(connection))
        self._losses = Draws(seed, "loss", str(connection))
        self._number = self._arrival_ns = 0

    def send(self, now_ns: int) -> tuple[int, int] | None:
        """The time of arrival of the next one, and its number; ``None``: it is lost.

        None overtakes another.
        """
        number = self._number = self._number + 1
        if self._loss and self._losses.share(number) < self._loss:
            return None
        share = 0.5 if self._delay.kind == "constant" else self._delays.share(number)
        delay_ns = max(LEAST_DELAY_NS, self._delay.at_ns(share))
        self._arrival_ns = max(self._arrival_ns, now_ns + delay_ns)
        return self._arrival_ns, number


class VirtualLink(MemoryLink):
    """One connection: each packet, and each acknowledgement, is under way for its delay."""

    __slots__ = ("_back", "_destination", "_source", "_there")

    def __init__(self, hub: VirtualHub, connection: Connection) -> None:
        super().__init__(hub, connection)
        self._source = hub.virtual.of(connection.source_node)
        self._destination = hub.virtual.of(connection.destination_node)
        self.begin_anew(hub.virtual.seed)

    def begin_anew(self, seed: str) -> None:
        """The first packet, and the first acknowledgement, come next."""
        self._there = OneWay(seed, "delay", self.connection)
        self._back = OneWay(seed, "acknowledgement", self.connection)

    def send(self, packet: Any, digest: int | None) -> None:
        way = self._there.send(self._source.now_ns)
        if way is not None:
            arrive = partial(self._arrive, packet, digest)
            self._destination.arrive(way[0], self.connection.index, way[1], arrive)

    def acknowledge(self, position: int) -> None:
        if not self._destination_end.is_open:
            return
        way = self._back.send(self._destination.now_ns)
        assert way is not None  # no acknowledgement is lost
        inbox = self._source_end.inbox
        arrive = partial(inbox.on_acknowledgement, self.connection, position, way[0])
        self._source.arrive(way[0], self.connection.index, way[1], arrive)

    def _arrive(self, packet: Any, digest: int | None) -> None:
        if digest is not None:
            self.received.append(digest)
        self._destination_end.inbox.on_packet(self.connection, packet)


class VirtualHub(MemoryHub):
    """Joins the nodes of one process in virtual time."""

    def __init__(self, loop: VirtualLoop, copier: Callable[[str], Callable[[Any], Any]]) -> None:
        super().__init__(loop, copier)
        self.virtual = loop

    def link(self, connection: Connection) -> VirtualLink:
        if connection not in self._links:
            self._links[connection] = VirtualLink(self, connection)
        link = self._links[connection]
        assert isinstance(link, VirtualLink)
        return link

    def _register(self, connection: Connection) -> None:
        source = connection.source_node
        event = partial(self.ends[source].inbox.on_registered, connection)
        self.virtual.of(source).post(event)


class VirtualTransport(MemoryTransport):
    """Carries packets to the other nodes of the process, each in its time."""

    def __init__(self, file: NodeFile, hub: VirtualHub, *more: Any) -> None:
        super().__init__(file, hub, *more)
        self.has_taken_in = hub.virtual.of(file.node.name).has_taken_in  # type: ignore[method-assign]
        self._virtual = hub

    def sender(self, connections: Sequence[Connection]) -> Callable[[Any], None]:
        for connection in connections:  # the node has just been made, or reset
            self._virtual.link(connection).begin_anew(self._virtual.virtual.seed)
        return super().sender(connections)

    def note_execution(self) -> None:
        """Nothing: see :class:`NodeTime`."""

    def give_way(self) -> None:
        """Nothing: the node whose event is next has its turn anyway."""


class VirtualMiddleware(LocalMiddleware):
    """Joins nodes in one thread, in virtual time (:class:`neuros.ports.Middleware`)."""

    def __init__(self, loop: VirtualLoop, *positional: Any, **named: Any) -> None:
        super().__init__(loop, *positional, **named)
        self._virtual = loop
        self.hub: VirtualHub = VirtualHub(loop, self.packets.copier)

    def loop_of(self, file: NodeFile) -> NodeTime:
        return self._virtual.of(file.node.name)

    def begin_anew(
        self, files: Sequence[NodeFile], variables: Mapping[str, Mapping[str, str]]
    ) -> None:
        nodes = (
            replace(f.node, environment={**f.node.environment, **variables.get(f.node.name, {})})
            for f in files
        )
        self._virtual.begin_anew(seed_of(nodes))

    def _memory_transport(self, file: NodeFile) -> Transport:
        return VirtualTransport(file, self.hub, self.bridge(file), self._digest, self._digests_of)
