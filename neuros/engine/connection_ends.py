"""Both ends of a connection: the send window, and the input queues.

"Publish and hope" loses packets, and a central controller costs a round trip per packet. Here the
receiver acknowledges a packet when a hook *starts* on it: earlier, a packet could be lost behind a
busy hook; later, nothing would overlap. The sender counts ``outstanding = sent - acknowledged`` and
blocks while this reaches the window ``K + N``, where K is the size of the receiver's input queue
and N the packets that it may discard in a row. N = 0 is lossless by construction: the queue has
room for all packets that may be sent. An acknowledgement carries a position, so a repeated or late
one does no harm.

A :class:`Subscription` is a connection (or external topic) at its receiver. Each hook that declares
the input has an :class:`InputQueue` there, and each gets every packet. A :class:`HookInput` is a
declared input of a hook: mostly a single queue, several if several connections feed the input.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from neuros.engine.metrics import Rest, State
from neuros.errors import ProtocolError
from neuros.hooks import InputSpec
from neuros.project.model import Connection


class Sender(Protocol):
    """A hook, for its send windows; ``blocked`` is the number of the blocked ones."""

    blocked: int


class SendWindow:
    """The send window of a connection: it blocks its hooks while it is full.

    Attributes:
        is_blocked: whether no packet may be sent.
        is_registered: whether the receiver is there.
        size: most outstanding packets, K + N.
        sent_ns: times of sent packets; the packet log empties it.
        hooks: that send on the connection.
    """

    __slots__ = (
        "acknowledged",
        "acknowledged_ns",
        "connection",
        "hooks",
        "is_blocked",
        "is_registered",
        "is_reliable",
        "rest",
        "sent",
        "sent_ns",
        "size",
    )

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.rest = Rest(State.BLOCKED, str(connection))
        self.size = connection.window
        self.is_reliable = connection.is_reliable
        self.is_registered = False
        self.is_blocked = False
        self.sent = 0
        self.sent_ns = array("q")
        self.acknowledged = 0
        self.acknowledged_ns: int | None = None
        self.hooks: list[Sender] = []

    @property
    def outstanding(self) -> int:
        """Packets sent and not acknowledged; 0 on a connection without acknowledgements."""
        return self.sent - self.acknowledged if self.is_reliable else 0

    @property
    def is_tight(self) -> bool:
        """Whether it is blocked, or could be after one more packet of each hook."""
        outstanding = self.sent - self.acknowledged
        return self.is_reliable and 0 < outstanding > self.size - (len(self.hooks) or 1)

    def spend(self, now_ns: int) -> None:
        """Count a sent packet."""
        self.sent += 1
        self.sent_ns.append(now_ns)
        if self.is_reliable and self.sent - self.acknowledged >= self.size and not self.is_blocked:
            self.is_blocked = True
            for hook in self.hooks:
                hook.blocked += 1

    def credit(self, position: int, now_ns: int) -> None:
        """Count an acknowledgement of all packets up to ``position``.

        Raises:
            ProtocolError: if more is acknowledged than was sent.
        """
        if position > self.sent:
            raise ProtocolError(
                f"{self.connection}: packet {position} was acknowledged, but only {self.sent}"
                " were sent: is a node of the same name running in this ROS domain?"
            )
        if position <= self.acknowledged:
            return
        self.acknowledged = position
        self.acknowledged_ns = now_ns
        if self.is_blocked and self.sent - position < self.size:
            self.is_blocked = False
            for hook in self.hooks:
                hook.blocked -= 1

    def frees(self, position: int) -> bool:
        """Whether an acknowledgement of ``position`` would unblock the window."""
        return self.sent - max(self.acknowledged, position) < self.size


class Consumer(Protocol):
    """A hook, for its inputs.

    Attributes:
        lacking: the number of inputs that lack a packet.
        is_open: whether the hook may start once none does.
        candidates: the hooks of the node that may start.
    """

    name: str
    missed_ticks: int
    lacking: int
    is_open: bool
    candidates: set[Any]

    def is_ready(self) -> bool:
        """Whether the hook may start now."""


class InputQueue:
    """The packets of a subscription that have arrived, and that one hook has not started on.

    Attributes:
        packets: ``(arrival, position, packet)``, oldest first; ``arrival`` counts the packets of
            the node, ``position`` those of the subscription, both from 1.
        position: of the last packet that the hook started on, at first 0.
        passed: position of the last packet that the hook started on or lost.
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
    """A connection or external topic at its receiver.

    Args:
        key: the connection, or the name of the input of an external topic.
        name: for messages.
        input_name: the input that the packets feed.
        capacity: most unread packets per queue.
        is_lossless: whether a full queue is an error of the sender, and not a discard.
        is_acknowledged: whether the sender waits for acknowledgements.

    Attributes:
        acknowledge: sends a position to the sender.
        consumed: packets that every hook has passed, and none has lost.
        discarded: packets that a hook has lost.
        counted: position up to which packets are consumed or discarded.
        taken: position of each packet that a hook has started on; the packet log empties it.
        taken_ns: times of these starts.
    """

    __slots__ = (
        "acknowledge",
        "acknowledged",
        "capacity",
        "consumed",
        "counted",
        "discarded",
        "input_name",
        "is_acknowledged",
        "is_lossless",
        "key",
        "longest_discard",
        "name",
        "queues",
        "received",
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
        self.counted = 0
        self.skipped: set[int] = set()
        self.taken = array("q")
        self.taken_ns = array("q")

    @property
    def is_external(self) -> bool:
        """Whether packets come from a plain ROS topic, at any time."""
        return isinstance(self.key, str)

    @property
    def source(self) -> str:
        """The sending node, or the topic, for messages."""
        key = self.key
        return key.source_node if isinstance(key, Connection) else f"topic {self.name}"

    @property
    def unread(self) -> int:
        """Packets that no hook has lost, and some hook has not started on."""
        return self.received - self.consumed - self.discarded

    def put(self, arrival: int, packet: Any) -> None:
        """Deliver a packet to each queue; without queues, acknowledge it.

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
            self._count_passed()
            self.acknowledge_consumed()

    def consume(self, queue: InputQueue, now_ns: int) -> Any:
        """Remove, return and acknowledge the oldest packet of ``queue``: its hook starts on it.

        ``None`` if there is none.
        """
        packets = queue.packets
        if not packets:
            return None
        _, position, packet = packets.popleft()
        if not packets:
            queue.hook_input.on_emptied()
        queue.position = queue.passed = position
        self.taken.append(position)
        self.taken_ns.append(now_ns)
        queue.discards_in_a_row = 0
        if len(self.queues) == 1:  # the common case
            self.counted = position
            self.consumed += 1
            if self.is_acknowledged:
                self.acknowledged = position
                self.acknowledge(position)
        else:
            self._count_passed()
            self.acknowledge_consumed()
        return packet

    def remove(self, queue: InputQueue) -> None:
        """Remove the queue of a hook that will never run again."""
        self.queues.remove(queue)
        queue.packets.clear()
        self._count_passed()
        self.acknowledge_consumed()

    def acknowledge_consumed(self) -> None:
        """Acknowledge the packets that every hook has started on, if there are new ones."""
        if self.is_acknowledged:
            position = self.position_if_consumed()
            if position > self.acknowledged:
                self.acknowledged = position
                self.acknowledge(position)

    def position_if_consumed(self, queue: InputQueue | None = None) -> int:
        """The smallest position of all queues, as if ``queue`` had consumed its oldest packet."""
        return min(
            (other.packets[0][1] if other is queue else other.position for other in self.queues),
            default=self.received,
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
        self._count_passed()
        if queue.packets:
            queue.hook_input.on_discarded()

    def _count_passed(self) -> None:
        """Count the packets that every hook has passed: consumed, unless one has lost them."""
        front = min((queue.passed for queue in self.queues), default=self.received)
        for position in range(self.counted + 1, front + 1):
            if position in self.skipped:
                self.skipped.discard(position)
            else:
                self.consumed += 1
        self.counted = max(self.counted, front)


def _nowhere(position: int) -> None:
    """``acknowledge`` of a connection without acknowledgements."""


class HookInput:
    """A declared input of a hook.

    Attributes:
        missing: number of packets that the hook still needs here.
        hook: is told when ``missing`` becomes 0, and when it no longer is.
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
        self.missing = 0 if self.is_optional else len(self.queues) if self.is_all else 1
        self.hook: Consumer

    def on_filled(self) -> None:
        """A queue is no longer empty."""
        self._filled += 1
        if self.missing:
            self.missing -= 1
            if not self.missing:
                hook = self.hook
                hook.lacking -= 1
                if not hook.lacking and hook.is_open:
                    hook.candidates.add(hook)

    def on_emptied(self) -> None:
        """A queue is empty."""
        self._filled -= 1
        if not self.is_optional and (self.is_all or not self._filled):
            self.missing += 1
            if self.missing == 1:
                self.hook.lacking += 1
                self.hook.candidates.discard(self.hook)

    def on_discarded(self) -> None:
        """The oldest packet of a queue was discarded, and further packets are there."""

    def has_reliable_packet(self) -> bool:
        """Whether a packet of a reliable connection waits here."""
        return self._filled > 0 and any(
            queue.packets and queue.subscription.is_acknowledged for queue in self.queues
        )

    def could_be_filled_from_outside(self) -> bool:
        """Whether external topics alone could bring the missing packets."""
        return self.missing <= sum(
            queue.subscription.is_external and not queue.packets for queue in self.queues
        )

    def has_waited(self, arrival: int) -> bool:
        """Whether the needed packets of external topics came up to ``arrival``."""
        return self.is_optional or not any(
            queue.subscription.is_external and queue.packets and queue.packets[0][0] > arrival
            for queue in self.queues
        )

    def chosen(self) -> InputQueue | None:
        """The queue of a plain input whose oldest packet has waited longest."""
        if len(self.queues) == 1:
            queue = self.queues[0]
            return queue if queue.packets else None
        return min(
            (queue for queue in self.queues if queue.packets),
            key=lambda queue: queue.packets[0][0],
            default=None,
        )

    def would_consume(self, queue: InputQueue) -> bool:
        """Whether a start of the hook would consume a packet of ``queue``."""
        return bool(queue.packets) and (self.is_all or self.chosen() is queue)

    def consumer(self) -> Callable[[int], Any]:
        """The function that returns the argument for a start of the hook; see :meth:`consume`."""
        if len(self.queues) != 1 or self.is_all:
            return self.consume
        return partial(self.queues[0].subscription.consume, self.queues[0])

    def consume(self, now_ns: int) -> Any:
        """The argument for the hook, which starts at a time, and so consumes the packets in it."""
        if self.is_all:
            return [queue.subscription.consume(queue, now_ns) for queue in self.queues]
        queue = self.queues[0] if len(self.queues) == 1 else self.chosen()
        return None if queue is None else queue.subscription.consume(queue, now_ns)
