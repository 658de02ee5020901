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
- The end of a run, for which a node asks at the end of a hook, travels along the connections in
  either direction, and nothing holds it up.

That is the null-message algorithm of Chandy and Misra (1979) and Bryant (1977), with states in the
place of promises, as link-state routing has them in the place of distances: promises that rest on
each other in a circle would rise by one delay per message only.

The time of the machine decides how long a node waits, and never what it does.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

NEVER_NS = 2**63 - 1
"""Later than every event, in nanoseconds of virtual time."""

_MOST_UNHANDLED = 256
"""Past messages that wait at a neighbour before the sender waits for it: bounds their memory."""


class Channel(NamedTuple):
    """One direction of a connection, at its sender.

    Attributes:
        name: the same at both ends.
        target: the receiving node.
        delay_ns: least delay of a message.
    """

    name: str
    target: str
    delay_ns: int


class Outbox(NamedTuple):
    """What a state says of a channel at its sender.

    Attributes:
        confirmed: number of messages that the receiver had received, as far as the sender knows.
        arrivals_ns: times of arrival of the others, in their order; none comes before another.
    """

    channel: Channel
    confirmed: int
    arrivals_ns: Sequence[int]

    def arrival_ns(self, received: int) -> int | None:
        """When the message after so many arrives; ``None``: it is not sent."""
        place = max(0, received - self.confirmed)
        return self.arrivals_ns[place] if place < len(self.arrivals_ns) else None


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
        is_ready: whether its initialise hooks have run, but for those that wait for packets.
        zero_ns: time 0 of the run, if that has come; else -1.
        ending: the earliest end of the run that it knows.
    """

    now_ns: int = 0
    next_ns: int = 0
    free_ns: int = -1
    is_ready: bool = False
    zero_ns: int = -1
    ending: Ending | None = None


class KnownState(NamedTuple):
    """The state of one node; ``version`` grows with each change.

    Attributes:
        sources: the nodes that send to the node.
        received: number of messages, by the name of the channel.
    """

    node: str
    version: int
    moment: Moment
    sources: Sequence[str]
    outboxes: Sequence[Outbox]
    received: Mapping[str, int]


class Horizon:
    """What a node knows of the states of all, and the horizon that follows from them.

    Args:
        node: its name.
        inward: the sending node of each channel that ends at the node, by the channel's name.
        outward: the channels that begin at the node.

    Attributes:
        neighbours: the nodes at the other ends of its channels.
        begun_ns: time 0 of the run, once that has come.
    """

    def __init__(self, node: str, inward: Mapping[str, str], outward: Sequence[Channel]) -> None:
        self.node = node
        self._sources = tuple(sorted(set(inward.values())))
        self._inward = inward
        self._received = dict.fromkeys(inward, 0)
        self._outward = {channel.name: channel for channel in outward}
        self.neighbours = {*self._sources, *(channel.target for channel in outward)}
        self._sent = dict.fromkeys(self._outward, 0)
        # Arrival times of the messages that are not received, and not handled, as far as is known.
        self._under_way: dict[str, deque[int]] = {name: deque() for name in self._outward}
        self._unhandled: dict[str, deque[int]] = {name: deque() for name in self._outward}
        self._states: dict[str, KnownState] = {}
        self._own = KnownState(node, 0, Moment(), self._sources, (), {})
        self._reach_ns: dict[str, int] = {}
        self.begun_ns: int | None = None

    # ------------------------------------------------------------------ what happens

    def send(self, channel: str, arrival_ns: int) -> None:
        """Count a message that the node sends."""
        self._sent[channel] += 1
        self._under_way[channel].append(arrival_ns)
        self._unhandled[channel].append(arrival_ns)

    def receive(self, channel: str) -> int:
        """Count a message that has come, in the order of the channel; returns its number."""
        number = self._received[channel] = self._received[channel] + 1
        return number

    def arrival_ns(self, channel: str) -> int | None:
        """When the next message of a channel arrives; ``None``: its sender has not told yet."""
        source = self._states.get(self._inward[channel])
        for outbox in () if source is None else source.outboxes:
            if outbox.channel.name == channel:
                return outbox.arrival_ns(self._received[channel])
        return None

    def learn(self, states: Iterable[KnownState]) -> list[str]:
        """Keep the states that are newer than what is known; returns whose they are."""
        news = []
        for state in states:
            known = self._states.get(state.node)
            if state.node != self.node and (known is None or known.version < state.version):
                news.append(state.node)
                self._states[state.node] = state
                if known is None:
                    self._reach_ns.clear()
                for name, channel in self._outward.items():
                    if channel.target == state.node:
                        self._forget(name, state)
        return news

    def is_between(self, node: str) -> bool:
        """Whether a neighbour of this node has no connection with another one."""
        state = self._states[node]
        near = {node, *state.sources, *(outbox.channel.target for outbox in state.outboxes)}
        return not self.neighbours <= near

    # ------------------------------------------------------------------ what follows

    def state(self, moment: Moment) -> KnownState:
        """The state of the node now; it has a new version if anything has changed."""
        outboxes = tuple(
            Outbox(channel, self._sent[name] - len(under_way), tuple(under_way))
            for (name, channel), under_way in zip(
                self._outward.items(), self._under_way.values(), strict=True
            )
        )
        _, version, *old = self._own
        if [moment, self._sources, outboxes, self._received] != old:
            self._own = KnownState(
                self.node, version + 1, moment, self._sources, outboxes, dict(self._received)
            )
        return self._own

    @property
    def others(self) -> Iterable[KnownState]:
        """The newest states of the other nodes."""
        return self._states.values()

    def waits_for(self, time_ns: int) -> str:
        """A node that keeps this one from its events at a time; empty if none does."""
        for name, queue in self._unhandled.items():
            if len(queue) > _MOST_UNHANDLED and queue[_MOST_UNHANDLED] < time_ns:
                return self._outward[name].target
        arrival_ns, source = min(self._arrivals(), default=(NEVER_NS, ""))
        return source if arrival_ns <= time_ns else ""

    def zero_ns(self, moment: Moment) -> int | None:
        """Time 0 of the run: when nothing is left to do before it; ``None``: not yet.

        That is the latest time of a node, once all are ready, no event waits and no message is
        under way. One that has begun tells the others, whose states may never show that.
        """
        for state in self._states.values():
            if state.moment.zero_ns >= 0:
                return state.moment.zero_ns
        states = {**self._states, self.node: self.state(moment)}
        if not self.neighbours <= states.keys():
            return None
        for state in states.values():
            is_idle = state.moment.next_ns == NEVER_NS and state.moment.free_ns < 0
            if not (is_idle and state.moment.is_ready and states.keys() >= {*state.sources}):
                return None
            for channel, confirmed, arrivals_ns in state.outboxes:
                target = states.get(channel.target)
                sent = confirmed + len(arrivals_ns)
                if target is None or target.received.get(channel.name, 0) != sent:
                    return None
        return max(state.moment.now_ns for state in states.values())

    @property
    def have_others_begun(self) -> bool:
        """Whether time 0 of the run has come at another node."""
        return any(state.moment.zero_ns >= 0 for state in self._states.values())

    def ending(self) -> Ending | None:
        """The earliest end of the run that another node knows."""
        known = (s.moment.ending for s in self._states.values())
        return min((each for each in known if each is not None), default=None)

    def reach_ns(self) -> Mapping[str, int]:
        """By node, the least time over connections, in either direction."""
        if not self._reach_ns:
            ways: dict[str, list[tuple[str, int]]] = {}
            for state in [self.state(self._own.moment), *self._states.values()]:
                for (_, target, delay_ns), _, _ in state.outboxes:
                    ways.setdefault(state.node, []).append((target, delay_ns))
                    ways.setdefault(target, []).append((state.node, delay_ns))
            ahead = [(0, self.node)]
            while ahead:
                time_ns, name = heapq.heappop(ahead)
                if name not in self._reach_ns:
                    self._reach_ns[name] = time_ns
                    for other, delay_ns in ways.get(name, ()):
                        heapq.heappush(ahead, (time_ns + delay_ns, other))
        return self._reach_ns

    # ------------------------------------------------------------------ inside

    def _forget(self, name: str, state: KnownState) -> None:
        """Forget messages that the receiver has received, or handled, by its state."""
        under_way, unhandled = self._under_way[name], self._unhandled[name]
        left = self._sent[name] - state.received.get(name, 0)
        while len(under_way) > left:
            under_way.popleft()
        while len(unhandled) > left and unhandled[0] < state.moment.now_ns:
            unhandled.popleft()

    def _arrivals(self) -> Iterable[tuple[int, str]]:
        """The earliest times of messages to the node, and of an end, each with its sender."""
        states, own = self._states, self._received
        first = {name: state.moment.next_ns for name, state in states.items()}
        if self.begun_ns is not None:
            for name, state in states.items():
                if state.moment.zero_ns < 0:  # time 0 will have hooks of it start
                    first[name] = min(first[name], self.begun_ns)
        for neighbour in self.neighbours:
            if neighbour not in states:
                yield 0, neighbour
        for name, under_way in self._under_way.items():
            target = self._outward[name].target
            if under_way and target in first:
                first[target] = min(first[target], under_way[0])
        for name, state in states.items():
            if any(source not in states and source != self.node for source in state.sources):
                first[name] = 0
            for outbox in state.outboxes:
                name_, target, _ = outbox.channel
                if target == self.node:
                    arrival_ns = outbox.arrival_ns(own[name_])
                    if arrival_ns is not None:
                        yield arrival_ns, name
                elif target in states:
                    arrival_ns = outbox.arrival_ns(states[target].received.get(name_, 0))
                    if arrival_ns is not None:
                        first[target] = min(first[target], arrival_ns)
        waiting = [(time_ns, name) for name, time_ns in first.items()]
        heapq.heapify(waiting)
        while waiting:  # Dijkstra's algorithm: the nodes in the order of their first events
            time_ns, name = heapq.heappop(waiting)
            if time_ns > first[name]:
                continue
            free_ns = states[name].moment.free_ns
            sent_ns = time_ns if free_ns < 0 else free_ns
            for channel, _, _ in states[name].outboxes:
                arrival_ns = sent_ns + channel.delay_ns
                if channel.target == self.node:
                    yield arrival_ns, name
                elif arrival_ns < first.get(channel.target, 0):
                    first[channel.target] = arrival_ns
                    heapq.heappush(waiting, (arrival_ns, channel.target))
        reach_ns = self.reach_ns()
        for name, time_ns in first.items():
            free_ns = states[name].moment.free_ns
            yield (time_ns if free_ns < 0 else free_ns) + reach_ns[name], name
