"""The receiving end of a connection: input queues, and the packets that hooks have started on.

A :class:`Subscription` is one connection (or external topic) at its receiver. Every hook that takes
the input has an :class:`InputQueue` of its own there, and every hook gets every packet. A
:class:`HookInput` is one declared input of one hook: a single queue mostly, several where an
input is fed by several connections.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from neuros.engine.metrics import Rest, State
from neuros.errors import ProtocolError
from neuros.hooks import InputSpec
from neuros.project.model import Connection


class Taker(Protocol):
    """A hook, as its inputs see it."""

    name: str
    missed_ticks: int

    def is_ready(self) -> bool:
        """Whether it may start now."""

    def on_input_complete(self) -> None:
        """One of its inputs has now what it needs."""

    def on_input_incomplete(self) -> None:
        """One of its inputs lacks something now."""


class InputQueue:
    """The packets of one subscription that have arrived and that one hook has not started on yet.

    Attributes:
        packets: ``(arrival, position, packet)``, oldest first; ``arrival`` orders the packets of
            the whole node, ``position`` counts from 1 on this subscription.
        position: of the last packet that the hook started on, 0 before.
        passed: of the last packet that the hook started on or lost.
    """

    __slots__ = ("discards_in_a_row", "hook_input", "packets", "passed", "position", "subscription")

    def __init__(self, subscription: Subscription, hook_input: HookInput) -> None:
        self.subscription = subscription
        self.hook_input = hook_input
        self.packets: deque[tuple[int, int, Any]] = deque()
        self.position = 0
        self.passed = 0
        self.discards_in_a_row = 0


class Subscription:
    """One connection or external topic at its receiver.

    Args:
        key: the connection, or the name of the input that an external topic is bound to.
        name: for messages.
        input_name: the input of the node that it feeds.
        capacity: unread packets per queue.
        is_lossless: whether a full queue is a fault of the sender rather than a discard.
        is_acknowledged: whether the sender waits for acknowledgements.

    Attributes:
        acknowledge: tells the sender a position.
        taken, taken_ns: the position of each packet that a hook has started on, and when that was,
            until the packet log takes these away.
    """

    __slots__ = (
        "acknowledge",
        "acknowledged",
        "capacity",
        "consumed",
        "discarded",
        "input_name",
        "is_acknowledged",
        "is_lossless",
        "key",
        "longest_discard",
        "name",
        "queues",
        "received",
        "settled",
        "skipped",
        "taken",
        "taken_ns",
    )

    def __init__(
        self,
        key: Connection | str,
        name: str,
        input_name: str,
        capacity: int,
        *,
        is_lossless: bool = False,
        is_acknowledged: bool = False,
    ) -> None:
        self.key = key
        self.name = name
        self.input_name = input_name
        self.capacity = capacity
        self.is_lossless = is_lossless
        self.is_acknowledged = is_acknowledged
        self.acknowledge: Callable[[int], None] = _nowhere
        self.queues: list[InputQueue] = []
        self.received = 0
        self.consumed = 0
        self.discarded = 0
        self.longest_discard = 0
        self.acknowledged = 0
        self.settled = 0
        self.skipped: set[int] = set()
        self.taken = array("q")
        self.taken_ns = array("q")

    @property
    def is_external(self) -> bool:
        """Whether it is a plain ROS topic, and so can bring a packet at any time."""
        return isinstance(self.key, str)

    @property
    def source(self) -> str:
        """The sending node, or the topic, for messages."""
        key = self.key
        return key.source_node if isinstance(key, Connection) else f"topic {self.name}"

    @property
    def unread(self) -> int:
        """Packets that some taker has still to start on, and that none has lost."""
        return self.received - self.consumed - self.discarded

    def put(self, arrival: int, packet: Any) -> None:
        """Deliver a packet to every taker; without takers, acknowledge it.

        Raises:
            ProtocolError: if the queue of a lossless connection is full.
        """
        self.received += 1
        for queue in self.queues:
            packets = queue.packets
            if len(packets) >= self.capacity:
                self._discard_oldest(queue)
            packets.append((arrival, self.received, packet))
            if len(packets) == 1:
                queue.hook_input.on_filled()
        if not self.queues:
            self._settle()
            self.acknowledge_taken()

    def take(self, queue: InputQueue, now_ns: int) -> Any:
        """The oldest packet of ``queue``, whose hook starts on it now; it is acknowledged."""
        _, position, packet = queue.packets.popleft()
        if not queue.packets:
            queue.hook_input.on_emptied()
        queue.position = queue.passed = position
        self.taken.append(position)
        self.taken_ns.append(now_ns)
        queue.discards_in_a_row = 0
        if len(self.queues) == 1:
            self.settled = position
            self.consumed += 1
        else:
            self._settle()
        self.acknowledge_taken()
        return packet

    def remove(self, queue: InputQueue) -> None:
        """Forget a taker: its hook will never run again."""
        self.queues.remove(queue)
        queue.packets.clear()
        self._settle()
        self.acknowledge_taken()

    def acknowledge_taken(self) -> None:
        """Tell the sender what every taker has started on, if that has grown."""
        if self.is_acknowledged:
            position = self.position_if_taken()
            if position > self.acknowledged:
                self.acknowledged = position
                self.acknowledge(position)

    def position_if_taken(self, queue: InputQueue | None = None) -> int:
        """Smallest position over all takers, if ``queue`` had started on its oldest packet."""
        queues = self.queues
        if len(queues) == 1 and queue is None:  # as nearly always
            return queues[0].position
        if not queues:
            return self.received
        return min(
            other.packets[0][1] if other is queue else other.position for other in self.queues
        )

    def _discard_oldest(self, queue: InputQueue) -> None:
        if self.is_lossless:
            raise ProtocolError(
                f"{self.name} is lossless, yet packet {self.received} arrived while"
                f" {self.capacity} were unread: its sender ignores acknowledgements"
            )
        _, position, _ = queue.packets.popleft()
        if not queue.packets:
            queue.hook_input.on_emptied()
        queue.passed = position
        queue.discards_in_a_row += 1
        self.longest_discard = max(self.longest_discard, queue.discards_in_a_row)
        if position not in self.skipped:
            self.skipped.add(position)
            self.discarded += 1
        self._settle()
        if queue.packets:
            queue.hook_input.on_discarded()

    def _settle(self) -> None:
        """Count what every taker is past: discarded if one of them lost it, consumed otherwise."""
        front = min((queue.passed for queue in self.queues), default=self.received)
        for position in range(self.settled + 1, front + 1):
            if position in self.skipped:
                self.skipped.discard(position)
            else:
                self.consumed += 1
        self.settled = max(self.settled, front)


def _nowhere(position: int) -> None:
    """Acknowledges on a connection without acknowledgements."""


class HookInput:
    """One declared input of one hook.

    Attributes:
        missing: number of packets that are still needed before its hook may start.
        hook: told when the input has all that it needs, or no longer.
    """

    __slots__ = ("_filled", "hook", "is_all", "is_optional", "missing", "name", "queues", "rest")

    def __init__(self, spec: InputSpec, subscriptions: list[Subscription]) -> None:
        self.name = spec.name
        self.rest = Rest(State.WAITING, spec.name)
        self.is_all = spec.is_all
        self.is_optional = spec.is_optional
        self.queues = [InputQueue(subscription, self) for subscription in subscriptions]
        for queue in self.queues:
            queue.subscription.queues.append(queue)
        self._filled = 0
        self.missing = self._count()
        self.hook: Taker

    def on_filled(self) -> None:
        """One of the queues is no longer empty."""
        self._filled += 1
        if self.missing:
            self.missing = self._count()
            if not self.missing:
                self.hook.on_input_complete()

    def on_emptied(self) -> None:
        """One of the queues is empty now."""
        self._filled -= 1
        was_missing, self.missing = self.missing, self._count()
        if self.missing and not was_missing:
            self.hook.on_input_incomplete()

    def on_discarded(self) -> None:
        """The oldest packet of a queue was discarded, and others are there."""

    def _count(self) -> int:
        if self.is_optional:
            return 0
        if self.is_all:
            return len(self.queues) - self._filled
        return 0 if self._filled else 1

    def has_reliable_packet(self) -> bool:
        """Whether a packet that must not be lost waits here."""
        return self._filled > 0 and any(
            queue.packets and queue.subscription.is_acknowledged for queue in self.queues
        )

    def could_be_filled_from_outside(self) -> bool:
        """Whether external topics alone could bring all that it still needs."""
        return self.missing <= sum(
            queue.subscription.is_external and not queue.packets for queue in self.queues
        )

    def has_waited(self, arrival: int) -> bool:
        """Whether what it needs of an external topic had come by then."""
        return self.is_optional or not any(
            queue.subscription.is_external and queue.packets and queue.packets[0][0] > arrival
            for queue in self.queues
        )

    def chosen(self) -> InputQueue | None:
        """For a plain input: the queue whose oldest packet has waited longest."""
        if len(self.queues) == 1:
            queue = self.queues[0]
            return queue if queue.packets else None
        return min(
            (queue for queue in self.queues if queue.packets),
            key=lambda queue: queue.packets[0][0],
            default=None,
        )

    def would_take(self, queue: InputQueue) -> bool:
        """Whether a start of the hook now would take from ``queue``."""
        return bool(queue.packets) and (self.is_all or self.chosen() is queue)

    def take(self, now_ns: int) -> Any:
        """The argument for the hook, which starts now."""
        if not self.is_all:
            queue = self.chosen()
            return None if queue is None else queue.subscription.take(queue, now_ns)
        return [q.subscription.take(q, now_ns) if q.packets else None for q in self.queues]
