"""The other nodes, as a node under test sees them: they send what the test says, and listen."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any

from neuros.core.send_window import SendWindow
from neuros.project.model import Connection, NodeFile, Port
from neuros.transport.memory import MemoryHub
from neuros.transport.messages import decode, encode


class Neighbours:
    """All nodes around one node (:class:`neuros.ports.Inbox` of each).

    Towards the node they keep the rules of each connection: what it does not take yet waits here.
    What it sends they start on at once, and so acknowledge, unless they are busy.
    """

    def __init__(self, file: NodeFile, hub: MemoryHub) -> None:
        name = file.node.name
        self.incoming = [c for c in file.connections if c.destination_node == name != c.source_node]
        self.outgoing = [c for c in file.connections if c.source_node == name != c.destination_node]
        self._windows = {connection: SendWindow(connection) for connection in self.incoming}
        self._waiting: dict[Connection, deque[Any]] = {c: deque() for c in self.incoming}
        self.received: dict[Connection, list[Any]] = {c: [] for c in self.outgoing}
        self._started: dict[Connection, int] = dict.fromkeys(self.outgoing, 0)
        self.busy: set[Connection] = set()
        self._hub = hub
        ends = [c.source_node for c in self.incoming] + [c.destination_node for c in self.outgoing]
        for end in dict.fromkeys(ends):
            hub.join(end, self, [c for c in self.incoming if c.source_node == end])

    def send(self, connection: Connection, packet: Any) -> None:
        """Send a packet, or keep it until the connection lets it through."""
        self._waiting[connection].append(decode(encode(packet)))
        self._send_waiting(connection)

    def unsent(self, connections: Sequence[Connection]) -> int:
        """Packets that wait for the node to take earlier ones."""
        return sum(len(self._waiting[connection]) for connection in connections)

    def start_on(self, connection: Connection, count: int | None) -> None:
        """Let a busy receiver start on ``count`` packets, or on all that it has."""
        started = self._started[connection]
        arrived = len(self.received[connection])
        position = arrived if count is None else min(arrived, started + count)
        if position > started:
            self._started[connection] = position
            if connection.is_reliable:
                node = self._hub.inboxes[connection.source_node]
                self._hub.post(partial(node.on_acknowledgement, connection, position))

    # ------------------------------------------------------------------ inbox

    def on_packet(self, connection: Connection, packet: Any) -> None:
        """The node has sent a packet."""
        self.received[connection].append(packet)
        if connection not in self.busy:
            self.start_on(connection, None)

    def on_external_packet(self, port: Port, packet: Any) -> None:
        """Neighbours have no external topics."""

    def on_acknowledgement(self, connection: Connection, position: int) -> None:
        """The node has started on packets: more may be sent."""
        self._windows[connection].credit(position, 0)
        self._send_waiting(connection)

    def on_registered(self, connection: Connection) -> None:
        """The node is always there."""

    def _send_waiting(self, connection: Connection) -> None:
        window, waiting = self._windows[connection], self._waiting[connection]
        while waiting and not window.is_blocked:
            window.spend(0)
            node = self._hub.inboxes[connection.destination_node]
            self._hub.post(partial(node.on_packet, connection, waiting.popleft()))
