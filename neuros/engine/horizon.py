"""Conservative synchronisation in virtual time: until when nothing more arrives at a node.

A node in a process of its own may handle an event only when nothing can arrive before it. So each
node tells its neighbours its state: the time of its next event, the end of the hook that runs, and
the messages that it has sent and received on each channel (a channel is one direction of a
connection: its packets, or its acknowledgements). They pass the states of others on. From the
states that a node knows, however old each is, follows the earliest time at which a message can
still reach it (its *horizon*):

- Every event to come begins with an event that waits at some node, or with a message under way,
  and a chain of messages leads from there to the node. Each link of the chain takes at least the
  least delay of its channel, and the least duration of a hook where one is needed.
- A state that is older than another can only make the horizon earlier: what a node has done since
  began with an event that its old state counts as waiting.
- Chains through the node itself are left out: it has not done yet what they would begin with.

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
        hold_ns: least time from the start of a hook to a message; -1: an arrival may cause one at
            once, also while a hook runs.
    """

    name: str
    target: str
    delay_ns: int
    hold_ns: int


class Outbox(NamedTuple):
    """What a state says of a channel at its sender.

    Attributes:
        sent: number of messages.
        arrival_ns: arrival of the first that the receiver had not received, as far as the sender
            knows; later ones arrive later.
    """

    channel: Channel
    sent: int
    arrival_ns: int


class NodeState(NamedTuple):
    """The state of one node; times in nanoseconds of virtual time.

    Attributes:
        version: grows with each change.
        now_ns: all events before this time are handled.
        next_ns: the next event that waits, the end of the hook left out.
        free_ns: the end of the hook that runs; -1: none runs.
        sources: the nodes that send to the node.
        received: number of messages, by the name of the channel.
    """

    node: str
    version: int
    now_ns: int
    next_ns: int
    free_ns: int
    sources: Sequence[str]
    outboxes: Sequence[Outbox]
    received: Mapping[str, int]


class Horizon:
    """What a node knows of the states of all, and the horizon that follows from them.

    Args:
        node: its name.
        inward: the sending node of each channel that ends at the node, by the channel's name.
        outward: the channels that begin at the node.
    """

    def __init__(self, node: str, inward: Mapping[str, str], outward: Sequence[Channel]) -> None:
        self.node = node
        self._sources = tuple(sorted(set(inward.values())))
        self._received = dict.fromkeys(inward, 0)
        self._outward = {channel.name: channel for channel in outward}
        self._sent = dict.fromkeys(self._outward, 0)
        # Arrival times of the messages that are not received, and not handled, as far as is known.
        self._under_way: dict[str, deque[int]] = {name: deque() for name in self._outward}
        self._unhandled: dict[str, deque[int]] = {name: deque() for name in self._outward}
        self._states: dict[str, NodeState] = {}
        self._own = NodeState(node, 0, 0, 0, -1, self._sources, (), {})
        self._news: dict[str, NodeState] = {}

    # ------------------------------------------------------------------ what happens

    def send(self, channel: str, arrival_ns: int) -> None:
        """Count a message that the node sends."""
        self._sent[channel] += 1
        self._under_way[channel].append(arrival_ns)
        self._unhandled[channel].append(arrival_ns)

    def receive(self, channel: str) -> None:
        """Count a message that has come, in the order of the channel."""
        self._received[channel] += 1

    def learn(self, states: Iterable[NodeState]) -> None:
        """Keep states that a neighbour has sent, and that are newer than what is known."""
        for state in states:
            known = self._states.get(state.node)
            if state.node != self.node and (known is None or known.version < state.version):
                self._states[state.node] = self._news[state.node] = state
                for name, channel in self._outward.items():
                    if channel.target == state.node:
                        self._forget(name, state)

    # ------------------------------------------------------------------ what follows

    def news(self, now_ns: int, next_ns: int, free_ns: int) -> Sequence[NodeState]:
        """The states that the neighbours do not have: of others, and of the node if it is new.

        The arguments are those of :class:`NodeState`.
        """
        outboxes = tuple(
            Outbox(channel, self._sent[name], under_way[0] if under_way else NEVER_NS)
            for (name, channel), under_way in zip(
                self._outward.items(), self._under_way.values(), strict=True
            )
        )
        own = self._own
        state = (now_ns, next_ns, free_ns, self._sources, outboxes, self._received)
        if state != own[2:]:
            self._own = self._news[self.node] = NodeState(
                self.node, own.version + 1, *state[:-1], dict(self._received)
            )
        news = tuple(self._news.values())
        self._news.clear()
        return news

    def time_ns(self) -> int:
        """The earliest time at which a message that has not come yet can arrive."""
        return min(self._arrivals(), default=(NEVER_NS, ""))[0]

    def waits_for(self, time_ns: int) -> str:
        """A neighbour that keeps the node from its events at a time; empty if none does."""
        for name, queue in self._unhandled.items():
            if len(queue) > _MOST_UNHANDLED and queue[_MOST_UNHANDLED] < time_ns:
                return self._outward[name].target
        arrival_ns, source = min(self._arrivals(), default=(NEVER_NS, ""))
        return source if arrival_ns <= time_ns else ""

    # ------------------------------------------------------------------ inside

    def _forget(self, name: str, state: NodeState) -> None:
        """Forget messages that the receiver has received, or handled, by its state."""
        under_way, unhandled = self._under_way[name], self._unhandled[name]
        left = self._sent[name] - state.received.get(name, 0)
        while len(under_way) > left:
            under_way.popleft()
        while len(unhandled) > left and unhandled[0] < state.now_ns:
            unhandled.popleft()

    def _arrivals(self) -> Iterable[tuple[int, str]]:
        """For each way into the node, the earliest time of a message on it, and its sender."""
        states, own = self._states, self._received
        first = {name: state.next_ns for name, state in states.items()}
        for source in self._sources:
            if source not in states:
                yield 0, source
        for name, under_way in self._under_way.items():
            if under_way:
                target = self._outward[name].target
                if target in first:
                    first[target] = min(first[target], under_way[0])
        for name, state in states.items():
            if any(source not in states and source != self.node for source in state.sources):
                first[name] = 0
            for channel, sent, arrival_ns in state.outboxes:
                target = channel.target
                if target == self.node:
                    if sent > own[channel.name]:
                        yield arrival_ns, name
                elif target in states and sent > states[target].received.get(channel.name, 0):
                    first[target] = min(first[target], arrival_ns)
        waiting = [(time_ns, name) for name, time_ns in first.items()]
        heapq.heapify(waiting)
        while waiting:  # Dijkstra's algorithm: the nodes in the order of their first events
            time_ns, name = heapq.heappop(waiting)
            if time_ns > first[name]:
                continue
            state = states[name]
            for channel, _, _ in state.outboxes:
                if state.free_ns < 0:
                    sent_ns = time_ns + max(0, channel.hold_ns)
                else:
                    sent_ns = time_ns if channel.hold_ns < 0 else state.free_ns
                arrival_ns = sent_ns + channel.delay_ns
                if channel.target == self.node:
                    yield arrival_ns, name
                elif arrival_ns < first.get(channel.target, 0):
                    first[channel.target] = arrival_ns
                    heapq.heappush(waiting, (arrival_ns, channel.target))
