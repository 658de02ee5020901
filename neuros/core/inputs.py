"""The receiving end of a connection: mailboxes, and who has taken what.

An :class:`Inlet` is one connection (or external topic) as its receiver sees it. Every hook that
takes the input has a :class:`Mailbox` of its own there, and every hook gets every packet. An
:class:`InputSlot` is one declared input of one hook: a single mailbox mostly, several where an
input is fed by several connections.
"""

from __future__ import annotations

from array import array
from collections import deque
from typing import TYPE_CHECKING, Any

from neuros.core.accounting import Rest, State
from neuros.errors import ProtocolError
from neuros.hooks import InputSpec
from neuros.project.model import Connection

if TYPE_CHECKING:
    from neuros.core.hook import Hook


class Mailbox:
    """The packets of one inlet that have arrived and that one hook has not started on yet.

    Attributes:
        packets: ``(arrival, position, packet)``, oldest first; ``arrival`` orders the packets of
            the whole node, ``position`` counts from 1 on this inlet.
        position: of the last packet that the hook started on, 0 before.
        passed: of the last packet that the hook started on or lost.
    """

    __slots__ = ("discards_in_a_row", "inlet", "packets", "passed", "position", "slot")

    def __init__(self, inlet: Inlet, slot: InputSlot) -> None:
        self.inlet = inlet
        self.slot = slot
        self.packets: deque[tuple[int, int, Any]] = deque()
        self.position = 0
        self.passed = 0
        self.discards_in_a_row = 0


class Inlet:
    """One connection or external topic at its receiver.

    Args:
        key: the connection, or the name of the input that an external topic is bound to.
        name: for messages.
        input_name: the input of the node that it feeds.
        capacity: unread packets per mailbox.
        is_lossless: whether a full mailbox is a fault of the sender rather than a discard.
        is_acknowledged: whether the sender waits for acknowledgements.

    Attributes:
        taken, taken_ns: the position of each packet that a hook has started on, and when that was,
            until somebody takes these away.
    """

    __slots__ = (
        "acknowledged",
        "capacity",
        "consumed",
        "discarded",
        "input_name",
        "is_acknowledged",
        "is_lossless",
        "key",
        "longest_discard",
        "mailboxes",
        "name",
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
        self.mailboxes: list[Mailbox] = []
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
        """Who sends on it, for messages."""
        key = self.key
        return key.source_node if isinstance(key, Connection) else f"topic {self.name}"

    @property
    def unread(self) -> int:
        """Packets that some taker has still to start on, and that none has lost."""
        return self.received - self.consumed - self.discarded

    def put(self, arrival: int, packet: Any) -> None:
        """Deliver a packet to every taker; raises ``ProtocolError`` if a lossless one is full."""
        self.received += 1
        for mailbox in self.mailboxes:
            packets = mailbox.packets
            if len(packets) >= self.capacity:
                self._discard_oldest(mailbox)
            if not packets:
                mailbox.slot.on_filled()
            packets.append((arrival, self.received, packet))
        if not self.mailboxes:
            self._settle()

    def take(self, mailbox: Mailbox) -> Any:
        """The oldest packet of ``mailbox``, whose hook starts on it now."""
        _, position, packet = mailbox.packets.popleft()
        if not mailbox.packets:
            mailbox.slot.on_emptied()
        mailbox.position = mailbox.passed = position
        self.taken.append(position)
        mailbox.discards_in_a_row = 0
        if len(self.mailboxes) == 1:
            self.settled = position
            self.consumed += 1
        else:
            self._settle()
        return packet

    def remove(self, mailbox: Mailbox) -> None:
        """Forget a taker: its hook will never run again."""
        self.mailboxes.remove(mailbox)
        mailbox.packets.clear()
        self._settle()

    def position_if_taken(self, mailbox: Mailbox | None = None) -> int:
        """Smallest position over all takers, if ``mailbox`` had started on its oldest packet."""
        mailboxes = self.mailboxes
        if len(mailboxes) == 1 and mailbox is None:  # as nearly always
            return mailboxes[0].position
        if not mailboxes:
            return self.received
        return min(
            other.packets[0][1] if other is mailbox else other.position for other in self.mailboxes
        )

    def _discard_oldest(self, mailbox: Mailbox) -> None:
        if self.is_lossless:
            raise ProtocolError(
                f"{self.name} is lossless, yet packet {self.received} arrived while"
                f" {self.capacity} were unread: its sender ignores acknowledgements"
            )
        _, position, _ = mailbox.packets.popleft()
        if not mailbox.packets:
            mailbox.slot.on_emptied()
        mailbox.passed = position
        mailbox.discards_in_a_row += 1
        self.longest_discard = max(self.longest_discard, mailbox.discards_in_a_row)
        if position not in self.skipped:
            self.skipped.add(position)
            self.discarded += 1
        self._settle()

    def _settle(self) -> None:
        """Count what every taker is past: discarded if one of them lost it, consumed otherwise."""
        front = min((mailbox.passed for mailbox in self.mailboxes), default=self.received)
        for position in range(self.settled + 1, front + 1):
            if position in self.skipped:
                self.skipped.discard(position)
            else:
                self.consumed += 1
        self.settled = max(self.settled, front)


class InputSlot:
    """One declared input of one hook.

    Attributes:
        missing: number of packets that the slot still needs before its hook may start.
        hook: the hook that it belongs to, told when the slot has all that it needs, or no longer.
    """

    __slots__ = ("_filled", "hook", "is_all", "is_optional", "mailboxes", "missing", "name", "rest")

    def __init__(self, spec: InputSpec, inlets: list[Inlet]) -> None:
        self.name = spec.name
        self.rest = Rest(State.WAITING, spec.name)
        self.is_all = spec.is_all
        self.is_optional = spec.is_optional
        self.mailboxes = [Mailbox(inlet, self) for inlet in inlets]
        for mailbox in self.mailboxes:
            mailbox.inlet.mailboxes.append(mailbox)
        self._filled = 0
        self.missing = self._count()
        self.hook: Hook

    def on_filled(self) -> None:
        """One of the mailboxes is no longer empty."""
        self._filled += 1
        if self.missing:
            self.missing = self._count()
            if not self.missing:
                self.hook.on_slot_complete()

    def on_emptied(self) -> None:
        """One of the mailboxes is empty now."""
        self._filled -= 1
        was_missing, self.missing = self.missing, self._count()
        if self.missing and not was_missing:
            self.hook.on_slot_incomplete()

    def _count(self) -> int:
        if self.is_optional:
            return 0
        if self.is_all:
            return len(self.mailboxes) - self._filled
        return 0 if self._filled else 1

    def has_reliable_packet(self) -> bool:
        """Whether a packet that must not be lost waits here."""
        return self._filled > 0 and any(
            mailbox.packets and mailbox.inlet.is_acknowledged for mailbox in self.mailboxes
        )

    def could_be_filled_from_outside(self) -> bool:
        """Whether external topics alone could bring all that it still needs."""
        return self.missing <= sum(
            mailbox.inlet.is_external and not mailbox.packets for mailbox in self.mailboxes
        )

    def chosen(self) -> Mailbox | None:
        """For a plain input: the mailbox whose oldest packet has waited longest."""
        if len(self.mailboxes) == 1:
            mailbox = self.mailboxes[0]
            return mailbox if mailbox.packets else None
        return min(
            (mailbox for mailbox in self.mailboxes if mailbox.packets),
            key=lambda mailbox: mailbox.packets[0][0],
            default=None,
        )

    def would_take(self, mailbox: Mailbox) -> bool:
        """Whether a start of the hook now would take from ``mailbox``."""
        return bool(mailbox.packets) and (self.is_all or self.chosen() is mailbox)

    def take(self, touched: list[Inlet]) -> Any:
        """The argument for the hook; appends the inlets that a packet was taken from."""
        if not self.is_all:
            mailbox = self.chosen()
            if mailbox is None:
                return None
            touched.append(mailbox.inlet)
            return mailbox.inlet.take(mailbox)
        taken = []
        for mailbox in self.mailboxes:
            if mailbox.packets:
                touched.append(mailbox.inlet)
                taken.append(mailbox.inlet.take(mailbox))
            else:
                taken.append(None)
        return taken
