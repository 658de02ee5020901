"""The in-memory transport: packets within one process, in the order in which they were sent.

rclcpp calls it intra-process communication. It needs no ROS itself: its user passes what
copies packets. So it is also the deterministic transport of the tests.
"""

from __future__ import annotations

from array import array
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Sequence
from typing import Any, Protocol

from neuros.ports import EventLoop, Inbox
from neuros.project.model import Connection, NodeFile, Port


class GraphBridge(Protocol):
    """ROS graph bridge: external topics, and subscriptions of ROS to the data topics."""

    @property
    def heard(self) -> Collection[Connection]:
        """The connections whose data topic has subscriptions."""

    def open(self, inbox: Inbox) -> None: ...
    def send_external(self, port: Port, packet: Any) -> None: ...
    def show(self, connections: Sequence[Connection], packet: Any) -> None: ...
    def close(self) -> None: ...


class MemoryHub:
    """Joins the nodes of one process.

    Args:
        loop: where packets and acknowledgements are events.
        copier: makes, for a type in ROS notation, the function that copies its packets. A copy must
            share nothing with the packet.

    Attributes:
        ends: the end of each node, by name; also of those that have not joined.
    """

    def __init__(
        self,
        loop: EventLoop,
        copier: Callable[[str], Callable[[Any], Any]],
    ) -> None:
        self.loop = loop
        self.copier = copier
        self.ends: dict[str, _End] = defaultdict(_End)
        self._links: dict[Connection, MemoryLink] = {}
        self._waiting: list[Connection] = []

    def link(self, connection: Connection) -> MemoryLink:
        """The link of a connection, one for both of its ends."""
        if connection not in self._links:
            self._links[connection] = MemoryLink(self, connection)
        return self._links[connection]

    def join(self, name: str, inbox: Inbox, connections: Sequence[Connection]) -> None:
        """Add a node, and tell the senders that waited for it."""
        self.ends[name].inbox = inbox
        self._waiting += [c for c in connections if c.source_node == name]
        for connection in tuple(self._waiting):
            if self.ends[connection.destination_node].inbox is not None:
                self._waiting.remove(connection)
                self._register(connection)

    def leave(self, name: str) -> None:
        """Let what is under way to a node go nowhere, and let nothing leave it."""
        end = self.ends[name]
        end.is_open = False
        if end.inbox is not None:
            end.inbox = _Nobody()

    def _register(self, connection: Connection) -> None:
        end = self.ends[connection.source_node]
        self.loop.post(lambda: end.inbox.on_registered(connection))


class MemoryTransport:
    """Carries packets to the other nodes of the process (:class:`neuros.ports.Transport`).

    ``digest`` makes a number of a packet; ``None``: no digests are kept, for a packet has to be
    serialised for one, which is not done here otherwise. Once it gives ``None``, none are kept any
    more. ``digests_of`` tells of which connections they are kept.
    """

    def __init__(
        self,
        file: NodeFile,
        hub: MemoryHub,
        bridge: GraphBridge,
        digest: Callable[[Any], int | None] | None = None,
        digests_of: Callable[[Connection], bool] = lambda _: True,
    ) -> None:
        self._node, self._name = file.node, file.node.name
        self._loop = hub.loop
        self._end = hub.ends[file.node.name]
        self._connections = file.connections
        self._hub = hub
        self._bridge = bridge
        self._is_turn_of_others = False
        self._digest = digest
        self.compressed: dict[str, tuple[int, int]] = {}  # nothing leaves the machine
        self.digests: dict[Connection, array[int]] = {}
        for c in file.connections:
            if c.source_node != c.destination_node and digest is not None and digests_of(c):
                link = hub.link(c)
                digests = link.sent if c.source_node == self._name else link.received
                self.digests[c] = digests

    def open(self, inbox: Inbox) -> None:
        self._end.is_open = True
        self._bridge.open(inbox)
        self._hub.join(self._name, inbox, self._connections)

    def sender(self, connections: Sequence[Connection]) -> Callable[[Any], None]:
        """Return what gives each receiver a copy of a packet, which its sender may keep."""
        if any(c.is_jpeg for c in connections):
            return self._sender_with_jpeg(connections)
        links = [self._hub.link(c) for c in connections]
        digested = [link for link in links if link.connection in self.digests]
        copy = self._hub.copier(self._node.output(connections[0].source_output).type)
        bridge, end = self._bridge, self._end

        def send(packet: Any) -> None:
            if not end.is_open:
                return
            digest = self._add_digest(digested, packet) if digested else None
            for link in links:
                link.send(copy(packet), digest)
            if bridge.heard:
                bridge.show(connections, packet)

        return send

    def _sender_with_jpeg(self, connections: Sequence[Connection]) -> Callable[[Any], None]:
        from neuros.transport.digests import digest_of_bytes
        from neuros.transport.envelope import Traffic
        from neuros.transport.jpeg import JpegCodec

        encoded = [c for c in connections if c.is_jpeg]
        links = [(self._hub.link(c), JpegCodec(c.quality, Traffic())) for c in encoded]
        others = [c for c in connections if not c.is_jpeg]
        send_to_others = self.sender(others) if others else None
        bridge = self._bridge

        def send(packet: Any) -> None:
            if not self._end.is_open:
                return
            for link, codec in links:
                data, digest = codec.encode(packet), None
                if link.connection in self.digests and self._digest is not None:
                    digest = digest_of_bytes(data)
                    link.sent.append(digest)
                link.send(codec.decode(data), digest)
            if bridge.heard:
                bridge.show(encoded, packet)
            if send_to_others is not None:
                send_to_others(packet)

        return send

    def send_external(self, port: Port, packet: Any) -> None:
        self._bridge.send_external(port, packet)

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        return self._hub.link(connection).acknowledge

    def note_execution(self) -> None:
        """A hook has ended: what is on its way here comes before the next one."""
        self._end.first = self._end.sent
        self._loop.note_execution()

    def give_way(self) -> None:
        """What waits for the other nodes comes before the next hook, and what they answer.

        All share one thread, and ticks that are always overdue would have it for themselves.
        """
        if self._loop.has_waiting_events:
            self._is_turn_of_others = True
            self._hub.loop.post(self._end_turn_of_others)

    def has_taken_in(self) -> bool:
        return (
            self._end.arrived >= self._end.first
            and not self._is_turn_of_others
            and self._loop.has_taken_in
        )

    def _end_turn_of_others(self) -> None:
        self._is_turn_of_others = False
        self._end.first = self._end.sent

    def waiting_for(self) -> Sequence[Connection]:
        ends = self._hub.ends
        return [
            c
            for c in self._connections
            if ends[c.source_node].inbox is None or ends[c.destination_node].inbox is None
        ]

    def close(self) -> None:
        self._hub.leave(self._name)
        self._bridge.close()

    def _add_digest(self, links: Sequence[MemoryLink], packet: Any) -> int | None:
        if self._digest is None:
            return None
        digest = self._digest(packet)
        if digest is None:
            self._digest = None  # of the rest, half would be of no use
            for connection in self.digests:
                if connection.source_node == self._name:
                    self._hub.link(connection).forget_digests()
            return None
        for link in links:
            link.sent.append(digest)
        return digest


class _End:
    """One node, and the packets and acknowledgements for it: each is an event in the loop.

    Attributes:
        inbox: the node; ``None``: it has not joined.
        is_open: whether it may send.
        sent: how many have been sent so far, but for packets that were lost in transport.
        arrived: how many of them have arrived.
        first: how many come before the next hook.
    """

    __slots__ = ("arrived", "first", "inbox", "is_open", "sent")

    def __init__(self) -> None:
        self.inbox: Any = None
        self.is_open = False
        self.sent = self.arrived = self.first = 0


class _Nobody:
    """Takes the place of a node that has left."""

    def on_packet(self, connection: Connection, packet: Any) -> None: ...
    def on_external_packet(self, port: Port, packet: Any) -> None: ...
    def on_acknowledgement(
        self, connection: Connection, position: int, arrival_ns: int | None = None
    ) -> None: ...
    def on_registered(self, connection: Connection) -> None: ...


class MemoryLink:
    """One connection: packets on their way, and the acknowledgements on theirs.

    Of the packets, those are the last K + N, as a DDS reader keeps them. A sender without
    acknowledgements (BEST_EFFORT) may be faster than its receiver for ever; what no longer fits is
    lost in transport, and the loop's queue stays short.

    Attributes:
        sent, received: the digests of packets.
    """

    __slots__ = (
        "_destination_end",
        "_loop",
        "_packets",
        "_positions",
        "_source_end",
        "_window",
        "connection",
        "received",
        "sent",
    )

    def __init__(self, hub: MemoryHub, connection: Connection) -> None:
        self._loop = hub.loop
        self.connection = connection
        self._window = connection.window
        self._packets: deque[tuple[Any, int | None]] = deque(maxlen=self._window)
        self._positions: deque[int] = deque()
        self._destination_end = hub.ends[connection.destination_node]
        self._source_end = hub.ends[connection.source_node]
        self.sent, self.received = array("Q"), array("Q")

    def send(self, packet: Any, digest: int | None) -> None:
        """Put a packet on its way, with its digest if that is kept."""
        if len(self._packets) < self._window:  # else an event is on its way for one that is lost
            self._destination_end.sent += 1
            self._loop.post(self._receive)
        self._packets.append((packet, digest))

    def acknowledge(self, position: int) -> None:
        """Put the acknowledgement of a position on its way back."""
        if self._destination_end.is_open:
            self._source_end.sent += 1
            self._positions.append(position)
            self._loop.post(self._receive_position)

    def forget_digests(self) -> None:
        """Keep none of the packets so far, nor of those on their way."""
        del self.sent[:]
        del self.received[:]
        for place, (packet, _) in enumerate(self._packets):
            self._packets[place] = (packet, None)

    def _receive(self) -> None:
        packet, digest = self._packets.popleft()
        if digest is not None:
            self.received.append(digest)
        end = self._destination_end
        end.arrived += 1
        end.inbox.on_packet(self.connection, packet)

    def _receive_position(self) -> None:
        end = self._source_end
        end.arrived += 1
        end.inbox.on_acknowledgement(self.connection, self._positions.popleft())
