"""Conservative synchronisation in virtual time: until when nothing more arrives at a node.

A node in a process of its own may handle an event only when nothing can arrive before it. So each
node tells its neighbours its state: the time of its next event, the end of the hook that runs, and
the messages that it has sent and received on each channel (a channel is one direction of a
connection: its packets, or its acknowledgements). They pass the states of others on. From the
states that a node knows, however old each is, follows the earliest time at which a message can
still reach it (its *horizon*):

- Every event to come begins with an event that waits at some node, or with a message under way,
  and a chain of messages leads from there to the node. Each link of the chain takes at least the
  least delay of its channel, and a node sends nothing while a hook holds it.
- A state that is older than another can only make the horizon earlier: what a node has done since
  began with an event that its old state counts as waiting.
- Chains through the node itself are left out: it has not done yet what they would begin with.
- The end of a run, for which a node asks at the end of a hook, takes :data:`END_NS`, which lets a
  node be that far behind the others.
- An acknowledgement changes what its receiver does only if that could block before it. Any other
  holds nothing up, and may be counted late. None is sent before the packet arrives.

That is the null-message algorithm of Chandy and Misra (1979) and Bryant (1977), with states in the
place of promises, as link-state routing has them in the place of distances: promises that rest on
each other in a circle would rise by one delay per message only.

Old states are safe, so a node tells a neighbour only what that may wait for (:meth:`Horizon.news`):
what it has sent to it, and, where a node waits for an event, each state that keeps it waiting. Two
nodes that only send to each other tell each other nothing else. A node that waits asks for that by
its own state; it is patient with a neighbour whose last messages all brought packets, since the
next one will most probably bring what it waits for, unasked.

The time of the machine decides how long a node waits, and never what it does.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

NEVER_NS = 2**63 - 1
"""Later than every event, in nanoseconds of virtual time."""
END_NS = 100_000_000
"""How long the end of a run, for which a node asks, takes to each other node."""

_MOST_UNHANDLED = 256
"""Past messages that wait at a neighbour before the sender waits for it: bounds their memory."""
_MOST_UNCONFIRMED = 64
"""Messages that a node receives before it says so: bounds what states list."""
_LAG_NS = END_NS // 2
"""A node that is so much further than it has told says so: others wait for no end from it."""


_TRUSTED = 2
"""So many messages in a row with packets, and a node is patient with their sender."""


class Channel(NamedTuple):
    """One direction of a connection, at its sender.

    Attributes:
        number: the same at both ends; acknowledgements of packets of channel n come on n + 1.
        target: the receiving node.
        delay_ns: least delay of a message.
        window: of acknowledgements, how many packets may be without one; 0: packets.
    """

    number: int
    target: str
    delay_ns: int
    window: int = 0


class Outbox(NamedTuple):
    """What a state says of a channel at its sender.

    Attributes:
        confirmed: number of messages that the receiver had received, as far as the sender knows.
        arrivals_ns: times of arrival of the others, in their order; none comes before another.
        positions: what they acknowledge, if they are acknowledgements.
    """

    channel: Channel
    confirmed: int
    arrivals_ns: Sequence[int]
    positions: Sequence[int]

    @property
    def sent(self) -> int:
        """Number of messages sent."""
        return self.confirmed + len(self.arrivals_ns)

    def arrival_ns(self, received: int) -> int | None:
        """When the message after so many arrives; ``None``: it is not sent."""
        place = max(0, received - self.confirmed)
        return self.arrivals_ns[place] if place < len(self.arrivals_ns) else None


class Answer(NamedTuple):
    """An acknowledgement that has come: its number on its channel, and what it acknowledges."""

    channel: int
    number: int
    arrival_ns: int
    position: int


class Ending(NamedTuple):
    """The end of a run: when it was asked for, by which node, and how long nodes may drain."""

    time_ns: int
    node: str
    drain_ns: int


class Moment(NamedTuple):
    """What a node has come to; times in nanoseconds of virtual time.

    Attributes:
        now_ns: all events before this time are handled.
        next_ns: the next event that waits, the end of the hook left out.
        free_ns: the end of the hook that runs; -1: none runs.
        waits_ns: the event that it may not handle yet; -1: it waits for no other node.
        causes: the nodes that keep it waiting.
        awaited: channels of acknowledgements that could change what it does.
        is_ready: whether its initialise hooks have run, but for those that wait for packets.
        zero_ns: time 0 of the run, if that has come; else -1.
        rounds: how often the run was let go: at time 0, and at the end of each pause.
        ending: the earliest end of the run that it knows.
    """

    now_ns: int = 0
    next_ns: int = 0
    free_ns: int = -1
    waits_ns: int = -1
    causes: Sequence[str] = ()
    awaited: Sequence[int] = ()
    is_ready: bool = False
    zero_ns: int = -1
    rounds: int = 0
    ending: Ending | None = None

    @property
    def since_ns(self) -> int:
        """It sends nothing more before this time."""
        return max(self.now_ns, self.free_ns)


class KnownState(NamedTuple):
    """The state of one node; ``version`` grows with each change.

    Attributes:
        sources: the nodes that send to the node.
        received: number of messages, by the number of the channel.
    """

    node: str
    version: int
    moment: Moment
    sources: Sequence[str]
    outboxes: Sequence[Outbox]
    received: Mapping[int, int]

    @property
    def near(self) -> set[str]:
        """The nodes that have a connection with it."""
        return {*self.sources, *(outbox.channel.target for outbox in self.outboxes)}


class Horizon:
    """What a node knows of the states of all, and the horizon that follows from them.

    Args:
        node: its name.
        inward: the sending node of each channel that ends at the node, by the channel's number.
        outward: the channels that begin at the node.

    Attributes:
        neighbours: the nodes at the other ends of its channels.
        rounds: how often the run was let go: at time 0, and at the end of each pause.
        is_behind: whether it was let go at another node once more than here.
        causes: the nodes that keep it from the event that it asked for last.
        withholds: whether it has been patient with one of them since it last told all it had to.
    """

    def __init__(self, node: str, inward: Mapping[int, str], outward: Sequence[Channel]) -> None:
        self.node = node
        self._sources = tuple(sorted(set(inward.values())))
        self._inward = inward
        self._received = dict.fromkeys(inward, 0)
        self._outward = {channel.number: channel for channel in outward}
        self.neighbours = sorted({*self._sources, *(channel.target for channel in outward)})
        self._least_delay_ns = min((c.delay_ns for c in outward), default=END_NS)
        self._sent = dict.fromkeys(self._outward, 0)
        # Messages that are not received, and arrival times of those that are not handled, as far as
        # is known.
        self._under_way: dict[int, deque[tuple[int, int]]] = {c: deque() for c in self._outward}
        self._unhandled: dict[int, deque[int]] = {c: deque() for c in self._outward}
        # By channel of acknowledgements that come, arrival times of packets that have none.
        self._unanswered: dict[int, deque[int]] = {c + 1: deque() for c in self._outward}
        self._answered = dict.fromkeys(self._unanswered, 0)
        self._inboxes: dict[int, Outbox] = {}
        # As the last state has them, and the channels that have changed since.
        self._outboxes = {c.number: Outbox(c, 0, (), ()) for c in outward}
        self._changed = {*self._outward}
        self._has_received = True
        self._states: dict[str, KnownState] = {}
        self._near: dict[str, set[str]] = {}  # the nodes that have a connection with each
        self._own = KnownState(node, 0, Moment(), self._sources, (), {})
        # By neighbour, what it was told, and the first instant that the node has handled since.
        self._told: dict[str, dict[str, KnownState]] = {name: {} for name in self.neighbours}
        self._since_ns: dict[str, int] = {}
        self._first: dict[str, tuple[int, str]] = {}
        # No message comes before this time, but for acknowledgements on other channels than these.
        self._nothing_before_ns, self._awaited = 0, set[int]()
        # By neighbour, how many of its last messages brought packets, without another in between.
        self._with_packets = dict.fromkeys(self.neighbours, 0)
        self.rounds = 0
        self._let_go_ns = 0
        self.causes: Sequence[str] = ()
        self.withholds = False

    # ------------------------------------------------------------------ what happens

    def let_go(self, time_ns: int) -> None:
        """Time 0 of the run has come, or a pause ends: now, in all nodes."""
        self.rounds += 1
        self._let_go_ns = time_ns
        self._nothing_before_ns = 0
        self.handle(time_ns)

    def handle(self, time_ns: int) -> None:
        """The node handles events of this instant."""
        if len(self._since_ns) < len(self.neighbours):
            for name in self.neighbours:
                self._since_ns.setdefault(name, time_ns)

    def send(self, channel: int, arrival_ns: int, position: int = 0) -> None:
        """Count a message that the node sends."""
        self._sent[channel] += 1
        self._changed.add(channel)
        self._under_way[channel].append((arrival_ns, position))
        self._unhandled[channel].append(arrival_ns)
        is_full = len(self._unhandled[channel]) > _MOST_UNHANDLED
        self._nothing_before_ns = 0 if is_full else min(self._nothing_before_ns, arrival_ns)
        if channel + 1 in self._inward:
            self._unanswered[channel + 1].append(arrival_ns)

    def receive(self, channel: int) -> int:
        """Count a message that has come, in the order of the channel; returns its number."""
        self._has_received = True
        number = self._received[channel] = self._received[channel] + 1
        return number

    def arrival_ns(self, channel: int) -> int | None:
        """When the next message of a channel arrives; ``None``: its sender has not told yet."""
        inbox = self._inboxes.get(channel)
        return None if inbox is None else inbox.arrival_ns(self._received[channel])

    def learn(self, states: Sequence[KnownState]) -> list[Answer]:
        """Keep the states that are newer than what is known; returns new acknowledgements.

        Args:
            states: what a neighbour tells, its own state first.
        """
        answers: list[Answer] = []
        sender, has_packets = states[0].node, False
        for state in states:
            known = self._states.get(state.node)
            if state.node == self.node or (known is not None and known.version >= state.version):
                continue
            self._states[state.node] = state
            if known is None:
                self._near[state.node] = state.near
            for number, channel in self._outward.items():
                if channel.target == state.node:
                    self._forget(number, state)
            for outbox in state.outboxes:
                number, target, _, window = outbox.channel
                if target == self.node:
                    old = self._inboxes.get(number)
                    if state.node == sender and not window:
                        has_packets |= outbox.sent > (0 if old is None else old.sent)
                    self._inboxes[number] = outbox
                    answers.extend(self._new_answers(outbox))
        self._with_packets[sender] = self._with_packets[sender] + 1 if has_packets else 0
        return answers

    # ------------------------------------------------------------------ what follows

    def state(self, moment: Moment) -> KnownState:
        """The state of the node now; it has a new version if anything has changed."""
        own = self._own
        if not self._changed and not self._has_received and moment == own.moment:
            return own
        for number in self._changed:
            under_way, channel = self._under_way[number], self._outward[number]
            arrivals_ns, positions = zip(*under_way, strict=True) if under_way else ((), ())
            self._outboxes[number] = Outbox(
                channel,
                self._sent[number] - len(under_way),
                arrivals_ns,
                positions if channel.window else (),
            )
        self._own = KnownState(
            self.node,
            own.version + 1,
            moment,
            self._sources,
            tuple(self._outboxes.values()) if self._changed else own.outboxes,
            self._received.copy() if self._has_received else own.received,
        )
        self._changed.clear()
        self._has_received = False
        return self._own

    def news(
        self, moment: Moment, *, is_all: bool = False, is_patient: bool = False
    ) -> Iterator[tuple[str, list[KnownState]]]:
        """The neighbours that wait for states, each with all that are known.

        Args:
            is_all: whether all get what is new, also if they wait for nothing.
            is_patient: whether the node, if it waits, asks only those that tell nothing unasked.
        """
        own = self.state(moment)
        self.withholds = False
        for name in self.neighbours:
            told = self._told[name]
            trust = self._with_packets[name] >= _TRUSTED if is_patient else False
            others = [state for node, state in self._states.items() if node != name]
            new = [
                state
                for state in (own, *others)
                if told.get(state.node) is not state
                and (state is own or name not in self._near[state.node])
            ]
            if new and (is_all or any(self._concerns(name, each, trust) for each in new)):
                told.update((state.node, state) for state in (own, *others))
                self._since_ns.pop(name, None)
                if moment.free_ns >= 0:  # what they are told lasts until the end of the hook
                    self._since_ns[name] = moment.free_ns
                # A state that no longer lists a message goes with that of its receiver.
                yield name, [own, *others]

    def waits_for(self, time_ns: int, awaited: Sequence[int] = ()) -> str:
        """A node that keeps this one from its events at a time; empty if none does.

        Args:
            awaited: channels of acknowledgements that could change what it does.
        """
        # What has been learnt since can only make arrivals later, and so the sum is not done again.
        if time_ns < self._nothing_before_ns and self._awaited.issuperset(awaited):
            self.causes = ()
            return ""
        for number, queue in self._unhandled.items():
            if len(queue) > _MOST_UNHANDLED and queue[_MOST_UNHANDLED] < time_ns:
                self.causes = [self._outward[number].target]
                return self._outward[number].target
        arrivals = [*self._arrivals(awaited)]
        for name, (first_ns, cause) in self._first.items():
            arrivals.append((min(first_ns, NEVER_NS - END_NS) + END_NS, name, cause))
        self._awaited = {*awaited}
        self._nothing_before_ns = min((each[0] for each in arrivals), default=NEVER_NS)
        early = [each for each in arrivals if each[0] <= time_ns]
        self.causes = sorted({cause for _, _, cause in early})
        return min(early)[1] if early else ""

    def behind(self, time_ns: int) -> Sequence[str]:
        """The nodes that may not have handled all up to a time."""
        _ = [*self._arrivals(())]
        self.causes = sorted(
            {cause for first_ns, cause in self._first.values() if first_ns <= time_ns}
        )
        return self.causes

    def zero_ns(self, moment: Moment) -> int | None:
        """Time 0 of the run: when nothing is left to do before it; ``None``: not yet.

        That is the latest time of a node, once all are ready, no event waits and no message is
        under way. One that has begun tells the others, whose states may never show that.
        """
        for state in self._states.values():
            if state.moment.zero_ns >= 0:
                return state.moment.zero_ns
        states = {**self._states, self.node: self.state(moment)}
        if not states.keys() >= {*self.neighbours}:
            return None
        for state in states.values():
            is_idle = state.moment.next_ns == NEVER_NS and state.moment.free_ns < 0
            if not (is_idle and state.moment.is_ready and states.keys() >= {*state.sources}):
                return None
            for outbox in state.outboxes:
                target = states.get(outbox.channel.target)
                if target is None or target.received.get(outbox.channel.number, 0) != outbox.sent:
                    return None
        return max(state.moment.now_ns for state in states.values())

    @property
    def is_behind(self) -> bool:
        """Whether the run was let go elsewhere: what arrives from there comes later than here."""
        return any(state.moment.rounds > self.rounds for state in self._states.values())

    @property
    def has_sent(self) -> bool:
        """Whether the node has sent packets, or awaited acknowledgements, since its last state."""
        awaited = {number for s in self._states.values() for number in s.moment.awaited}
        return any(not self._outward[n].window or n in awaited for n in self._changed)

    @property
    def is_under_way(self) -> bool:
        """Whether a message has been sent of which no neighbour has told yet that it has come."""
        return any(self._under_way.values())

    def ending(self) -> Ending | None:
        """The earliest end of the run that another node knows."""
        known = (s.moment.ending for s in self._states.values())
        return min((each for each in known if each is not None), default=None)

    # ------------------------------------------------------------------ inside

    def _new_answers(self, outbox: Outbox) -> Iterator[Answer]:
        """The acknowledgements of a channel that have not come before."""
        number = outbox.channel.number
        for position in outbox.positions[self._received[number] - outbox.confirmed :]:
            arrival_ns = outbox.arrival_ns(self._received[number])
            assert arrival_ns is not None
            for _ in range(position - self._answered[number]):
                self._unanswered[number].popleft()
            self._answered[number] = max(position, self._answered[number])
            yield Answer(number, self.receive(number), arrival_ns, position)

    def _forget(self, number: int, state: KnownState) -> None:
        """Forget messages that the receiver has received, or handled, by its state."""
        under_way, unhandled = self._under_way[number], self._unhandled[number]
        left = self._sent[number] - state.received.get(number, 0)
        while len(under_way) > left:
            self._changed.add(number)
            under_way.popleft()
        while len(unhandled) > left and unhandled[0] < state.moment.now_ns:
            unhandled.popleft()

    def _pending_ns(self, state: KnownState) -> int:
        """The event that a node is to handle next, as far as is known; -1: none."""
        times = [state.moment.next_ns]
        for number, under_way in self._under_way.items():
            if under_way and self._outward[number].target == state.node:
                times.append(under_way[0][0])
        time_ns = min(times)
        return -1 if time_ns == NEVER_NS else max(time_ns, state.moment.since_ns)

    def _concerns(self, name: str, state: KnownState, trust: bool) -> bool:
        """Whether a neighbour, or a node behind it, may wait for a new state of a node."""
        old = self._told[name].get(state.node)
        if old is None or state.moment.zero_ns < 0:
            return True
        before, now = old.moment, state.moment
        since_ns, holds = before.since_ns, now.free_ns > now.now_ns
        if before.rounds < now.rounds:
            return True
        if state is self._own:
            if before.ending != now.ending or self._has_sent(name, old):
                return True
            since_ns = self._since_ns.get(name, NEVER_NS) + self._least_delay_ns
        # Also if it waited for the same before: an older state may have come on another way since.
        if now.waits_ns >= 0:
            if state is not self._own or not self._told.keys() >= {*now.causes}:
                return True  # for a node behind a neighbour
            if name in now.causes:
                if not trust:
                    return True
                self.withholds = True
        if now.now_ns - before.now_ns >= _LAG_NS:
            return True
        for other in self._states.values():
            # Another neighbour that waits is told itself.
            if other.node == name or other.node not in self._told:
                waits_ns, causes = other.moment.waits_ns, other.moment.causes
                if since_ns <= waits_ns and state.node in causes:
                    return True
                if holds and state is self._own and since_ns <= self._pending_ns(other):
                    return True
        return False

    def _has_sent(self, name: str, old: KnownState) -> bool:
        """Whether there are messages that a neighbour must know of, or confirm."""
        own = self._own
        awaited = self._states[name].moment.awaited if name in self._states else ()
        for outbox, before in zip(own.outboxes, old.outboxes, strict=True):
            number, target, _, window = outbox.channel
            if target == name and outbox is not before and (sent := outbox.sent - before.sent):
                if not window or number in awaited or own.moment.ending is not None:
                    return True
                if 2 * sent >= window:
                    return True
        return own.received is not old.received and any(
            count - old.received[number] >= _MOST_UNCONFIRMED
            for number, count in own.received.items()
            if self._inward[number] == name
        )

    def _arrivals(self, awaited: Sequence[int]) -> Iterable[tuple[int, str, str]]:
        """The earliest times of messages to the node.

        Each with its sender, and the node whose event may be the first cause of it. Afterwards,
        ``_first`` has the earliest event of each node, and its cause.
        """
        states, own = self._states, self._received
        first = {name: state.moment.next_ns for name, state in states.items()}
        for name, state in states.items():
            if state.moment.rounds < self.rounds:  # hooks of it will start when it is let go
                first[name] = min(first[name], self._let_go_ns)
        for neighbour in self.neighbours:
            if neighbour not in states:
                yield 0, neighbour, neighbour
        # Channels that count, by their sender.
        ways: dict[str, list[Channel]] = {}
        outboxes = [(name, each) for name, state in states.items() for each in state.outboxes]
        for name, outbox in outboxes:
            channel = outbox.channel
            number, target, _, window = channel
            if target == self.node:
                if window and (number not in awaited or not self._unanswered[number]):
                    continue
                arrival_ns = outbox.arrival_ns(own[number])
                if arrival_ns is not None:
                    yield arrival_ns, name, name
            elif target in states:
                known = states[target]
                if window and number not in known.moment.awaited:
                    continue
                arrival_ns = outbox.arrival_ns(known.received.get(number, 0))
                if arrival_ns is not None and arrival_ns < first[target]:
                    first[target] = arrival_ns
            ways.setdefault(name, []).append(channel)
        for number, under_way in self._under_way.items():
            _, target, _, window = self._outward[number]
            if (
                under_way
                and target in first
                and not (window and number not in states[target].moment.awaited)
            ):
                first[target] = min(first[target], under_way[0][0])
        waiting = []
        for name, state in states.items():
            if any(source not in states and source != self.node for source in state.sources):
                first[name] = 0
            free_ns = state.moment.free_ns
            first[name] = free_ns if free_ns >= 0 else max(first[name], state.moment.now_ns)
            waiting.append((first[name], name))
        cause = {name: name for name in states}
        heapq.heapify(waiting)
        while waiting:  # Dijkstra's algorithm: the nodes in the order in which they may send
            time_ns, name = heapq.heappop(waiting)
            if time_ns > first[name] or time_ns == NEVER_NS:
                continue
            for number, target, delay_ns, window in ways.get(name, ()):
                arrival_ns = time_ns + delay_ns
                if target == self.node:
                    if window:
                        arrival_ns = max(arrival_ns, self._unanswered[number][0] + delay_ns)
                    yield arrival_ns, name, cause[name]
                elif target in states and states[target].moment.free_ns < 0:
                    sent_ns = max(arrival_ns, states[target].moment.now_ns)
                    if sent_ns < first[target]:
                        first[target], cause[target] = sent_ns, cause[name]
                        heapq.heappush(waiting, (sent_ns, target))
        self._first = {name: (time_ns, cause[name]) for name, time_ns in first.items()}
