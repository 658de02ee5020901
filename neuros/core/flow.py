"""The sending end of a connection: how a receiver's readiness reaches back to the sender.

"Publish and hope" loses packets, and asking a central controller costs a round trip for each. Here
the receiver acknowledges a packet when a hook *starts* on it, neither earlier (then a packet could
be lost behind a busy hook) nor later (then nothing would overlap). The sender counts: ``outstanding
= sent - acknowledged``. It blocks while that reaches the window ``K + N``, where K is what the
receiver's mailbox holds and N what it may discard in a row. N = 0 is then lossless by construction:
the mailbox always has room for what may be sent. Since an acknowledgement carries a position and
not a mere "one more", it is cumulative; a repeated or late one does no harm.
"""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

from neuros.core.accounting import Rest, State
from neuros.errors import ProtocolError

if TYPE_CHECKING:
    from neuros.core.hook import Hook
    from neuros.project.model import Connection


class Outlet:
    """One connection at its sender.

    Attributes:
        is_blocked: whether nothing may be sent on it now.
        is_registered: whether its receiver is known to be there.
        sent_ns: when each packet was sent, until somebody takes the times away.
        hooks: those with this outlet among their outputs; each counts its blocked outlets.
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
        "window",
    )

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.rest = Rest(State.BLOCKED, str(connection))
        self.window = connection.window
        self.is_reliable = connection.is_reliable
        self.is_registered = False
        self.is_blocked = False
        self.sent = 0
        self.sent_ns = array("q")
        self.acknowledged = 0
        self.acknowledged_ns: int | None = None
        self.hooks: list[Hook] = []

    @property
    def outstanding(self) -> int:
        """Packets sent and not acknowledged yet; 0 where nobody acknowledges."""
        return self.sent - self.acknowledged if self.is_reliable else 0

    def spend(self, now_ns: int) -> None:
        """Count a packet that is sent now."""
        self.sent += 1
        self.sent_ns.append(now_ns)
        if (
            self.is_reliable
            and self.sent - self.acknowledged >= self.window
            and not self.is_blocked
        ):
            self.is_blocked = True
            for hook in self.hooks:
                hook.blocked += 1

    def credit(self, position: int, now_ns: int) -> None:
        """Take an acknowledgement of all packets up to ``position``.

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
        if self.is_blocked and self.sent - position < self.window:
            self.is_blocked = False
            for hook in self.hooks:
                hook.blocked -= 1

    def frees(self, position: int) -> bool:
        """Whether an acknowledgement of ``position`` would leave it unblocked."""
        return self.sent - max(self.acknowledged, position) < self.window
