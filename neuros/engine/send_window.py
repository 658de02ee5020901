"""The sending end of a connection: counts the packets that the receiver has not started on.

"Publish and hope" loses packets, and a central controller costs a round trip per packet. Here the
receiver acknowledges a packet when a hook *starts* on it: earlier, a packet could be lost behind a
busy hook; later, nothing would overlap. The sender counts ``outstanding = sent - acknowledged`` and
blocks while this reaches the window ``K + N``, where K is the size of the receiver's input queue
and N the packets that it may discard in a row. N = 0 is lossless by construction: the queue has
room for all packets that may be sent. An acknowledgement carries a position, so a repeated or late
one does no harm.
"""

from __future__ import annotations

from array import array
from typing import Protocol

from neuros.engine.metrics import Rest, State
from neuros.errors import ProtocolError
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
        outstanding = self.outstanding
        return 0 < outstanding > self.size - max(1, len(self.hooks))

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
