"""Conservative synchronisation of nodes in virtual time: until when nothing more arrives at a node.

A node that runs in a process of its own handles an event only when no neighbour can still send it
an earlier one. Each neighbour promises until when nothing of it arrives (Chandy and Misra 1979;
Bryant 1977). A promise is conditional: it holds unless something causes it to break that the
neighbour has not received when it promises. So two idle nodes promise each other "never", where
unconditional promises would rise by one delay per message for ever.

Nothing here depends on the time of the machine: which event comes next is a property of the
project alone. Only how long a node waits depends on the others.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

NEVER_NS = 2**63 - 1
"""Later than every event, in nanoseconds of virtual time."""

_MOST_AHEAD = 256
"""Messages that a neighbour has not handled although they are past, before a node waits for it."""


class Promise(NamedTuple):
    """What a node says to a neighbour; times in nanoseconds of virtual time.

    Attributes:
        until_ns: nothing of the node arrives before, beyond the messages counted by ``sent``.
        now_ns: the node has handled its events up to this time.
        wanted_ns: the node waits for a promise beyond this time; 0: for none.
        sent: messages sent to the neighbour, by channel.
        received: messages received from the neighbour, by channel.
    """

    until_ns: int
    now_ns: int
    wanted_ns: int
    sent: Sequence[int]
    received: Sequence[int]


class Neighbour:
    """A node at the other end of connections, as one node knows it.

    A channel is one direction of one connection: its packets, or its acknowledgements. Messages of
    a channel arrive in their order, messages of different channels and promises in any.

    Args:
        inward: number of channels that bring messages from the neighbour.
        outward: number of channels that take messages to it.
        delay_in_ns: least delay of the inward channels.
        delay_out_ns: least delay of the outward channels.

    Attributes:
        hold_ns: least time from the start of a hook to the first message to the neighbour.
        answers_at_once: whether an arrival may cause a message to the neighbour while a hook runs.
    """

    def __init__(
        self, name: str, inward: int, outward: int, *, delay_in_ns: int, delay_out_ns: int
    ) -> None:
        self.name = name
        self.hold_ns = 0
        self.answers_at_once = False
        self.delay_out_ns = delay_out_ns
        self._delay_in_ns = delay_in_ns
        self._until_ns = delay_in_ns if inward else NEVER_NS
        self._now_ns = 0
        self._received = [0] * inward
        self._sent = [0] * outward
        # Arrival times of messages that no promise covers, and of those that are not handled.
        self._uncovered: list[deque[int]] = [deque() for _ in range(outward)]
        self._unhandled: list[deque[int]] = [deque() for _ in range(outward)]
        self._covered = [0] * outward
        self._early: deque[Promise] = deque()  # promises that have overtaken messages
        self.wanted_ns = 0  # by the neighbour
        self._asked_ns = self._sent_asked_ns = 0  # of the neighbour
        self._promised_ns = delay_out_ns if outward else NEVER_NS
        self._newest_ns = NEVER_NS  # the first arrival since the last promise to the neighbour
        self._new = 0

    @property
    def until_ns(self) -> int:
        """Nothing of the neighbour arrives before this time, beyond what is here."""
        times = [queue[0] for queue in self._uncovered if queue]
        return min(self._until_ns, min(times) + self._delay_in_ns) if times else self._until_ns

    @property
    def believed_ns(self) -> int:
        """The time until which the neighbour expects nothing, as far as the node knows."""
        return min(self._promised_ns, self._newest_ns + self.delay_out_ns)

    def is_far_behind(self, now_ns: int) -> bool:
        """Whether too many messages that are past at ``now_ns`` wait at the neighbour."""
        return any(len(q) > _MOST_AHEAD and q[_MOST_AHEAD] < now_ns for q in self._unhandled)

    def ask(self, time_ns: int) -> None:
        """Ask for a promise beyond a time, with the next message to the neighbour."""
        self._asked_ns = max(self._asked_ns, time_ns)

    def send(self, channel: int, arrival_ns: int) -> None:
        """Count a message to the neighbour."""
        self._sent[channel] += 1
        if self._received:
            self._uncovered[channel].append(arrival_ns)
        self._unhandled[channel].append(arrival_ns)

    def receive(self, channel: int, arrival_ns: int) -> None:
        """Count a message of the neighbour."""
        self._received[channel] += 1
        self._newest_ns = min(self._newest_ns, arrival_ns)
        self._new += 1
        if self._early:
            self._apply()

    def receive_promise(self, promise: Promise) -> None:
        """Apply a promise as soon as all messages are here that were sent before it."""
        self.wanted_ns = max(self.wanted_ns, promise.wanted_ns)
        self._now_ns = max(self._now_ns, promise.now_ns)
        for queue in self._unhandled:
            while queue and queue[0] <= self._now_ns:
                queue.popleft()
        self._early.append(promise)
        self._apply()

    def is_due(self, until_ns: int, *, has_acted: bool) -> bool:
        """Whether the neighbour needs a new promise of this time, or a question."""
        if self._asked_ns > self._sent_asked_ns or self._new >= _MOST_AHEAD // 2:
            return True
        believed_ns = self.believed_ns
        return until_ns > believed_ns and (has_acted or self.wanted_ns >= believed_ns)

    def promise(self, until_ns: int, now_ns: int) -> Promise:
        """The promise that is sent to the neighbour now."""
        self._promised_ns, self._newest_ns, self._new = until_ns, NEVER_NS, 0
        self._sent_asked_ns = self._asked_ns
        return Promise(until_ns, now_ns, self._asked_ns, tuple(self._sent), tuple(self._received))

    def _apply(self) -> None:
        while self._early and all(
            here >= sent for here, sent in zip(self._received, self._early[0].sent, strict=True)
        ):
            promise = self._early.popleft()
            if not self._received:
                continue
            self._until_ns = promise.until_ns
            for channel, count in enumerate(promise.received):
                for _ in range(count - self._covered[channel]):
                    self._uncovered[channel].popleft()
                self._covered[channel] = count


class Promises:
    """What the neighbours of a node promise it, and what it promises them."""

    def __init__(self, neighbours: Sequence[Neighbour]) -> None:
        self.neighbours = {each.name: each for each in neighbours}

    def waits_for(self, time_ns: int) -> list[str]:
        """The neighbours that keep a node from its events at a time; they are asked."""
        found = []
        for name, each in self.neighbours.items():
            if each.until_ns <= time_ns:
                each.ask(time_ns)
                found.append(name)
            elif each.is_far_behind(time_ns):
                found.append(name)
        return found

    def due(
        self, next_ns: int, now_ns: int, *, free_ns: int | None, has_acted: bool
    ) -> list[tuple[str, Promise]]:
        """The promises to send now, by neighbour.

        Args:
            next_ns: the time of the next event of the node, the end of its hook left out.
            now_ns: all events before this time are handled.
            free_ns: the end of the running hook; ``None``: none runs.
            has_acted: whether the node has handled events since the last call: then each neighbour
                learns what becomes of it. Promises of others are passed on to those who asked.
        """
        untils = [(each, each.until_ns) for each in self.neighbours.values()]
        promised: list[tuple[Neighbour, int]] = []
        for each, _ in untils:
            ahead_ns = each.delay_out_ns
            if free_ns is not None and not each.answers_at_once:
                start_ns = free_ns
            else:
                start_ns = min([next_ns, *(until for other, until in untils if other is not each)])
                if free_ns is not None:
                    start_ns = min(start_ns, free_ns)
                else:
                    ahead_ns += each.hold_ns
                if start_ns + ahead_ns <= each.wanted_ns:
                    for other, until_ns in untils:
                        if other is not each and until_ns <= start_ns:
                            other.ask(each.wanted_ns - ahead_ns)
            promised.append((each, min(NEVER_NS, start_ns + ahead_ns)))
        return [
            (each.name, each.promise(until_ns, now_ns))
            for each, until_ns in promised
            if each.is_due(until_ns, has_acted=has_acted)
        ]
