"""The in-memory transport: packets within one process, in the order in which they were sent.

rclcpp calls it intra-process communication. It needs no ROS itself: its user passes the function
that copies a packet. So it is also the deterministic transport of the tests.
"""

from __future__ import annotations

from array import array
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Sequence
from typing import Any, Protocol

from neuros.ports import EventLoop, Inbox
from neuros.project.model import Connection, NodeFile, Port
from neuros.transport.ownership import is_unshared_inside, unheld


class GraphBridge(Protocol):
    """ROS graph bridge: external topics, and subscriptions of ROS to the data topics."""

    @property
    def heard(self) -> Collection[Connection]:
        """The connections whose data topic has subscriptions."""

    def open(self, inbox: Inbox) -> None: ...
    def send_external(self, port: Port, packet: Any) -> None: ...
    def show(self, connections: Sequence[Connection], packet: Any) -> None: ...
    def make_packet(self, type_name: str) -> Any: ...
    def close(self) -> None: ...


class MemoryHub:
    """Joins the nodes of one process.

    Args:
        loop: where packets and acknowledgements are events.
        copy: what it returns must share nothing with its argument.

    Attributes:
        received: where the digests of what is received go, by connection.
        arrivals: what is on its way to each node.
    """

    def __init__(
        self,
        loop: EventLoop,
        copy: Callable[[Any], Any],
    ) -> None:
        self.loop = loop
        self.post = loop.post
        self.copy = copy
        self.arrivals: dict[str, _Arrivals] = defaultdict(_Arrivals)
        self.received: dict[Connection, array[int]] = {}
        self.inboxes: dict[str, Inbox] = {}
        self._waiting: list[Connection] = []

    def join(self, name: str, inbox: Inbox, connections: Sequence[Connection]) -> None:
        """Add a node, and tell the senders that waited for it."""
        self.inboxes[name] = inbox
        self._waiting += [c for c in connections if c.source_node == name]
        for connection in tuple(self._waiting):
            if connection.destination_node in self.inboxes:
                self._waiting.remove(connection)
                self._register(connection)

    def leave(self, name: str) -> None:
        """Let what is under way to a node go nowhere."""
        if name in self.inboxes:
            self.inboxes[name] = _Nobody()

    def _register(self, connection: Connection) -> None:
        self.post(lambda: self.inboxes[connection.source_node].on_registered(connection))


class MemoryTransport:
    """Carries the packets of one node to the others in its process.

    ``digest`` makes a number of a packet; ``None``: no digests are kept, for a packet has to be
    serialised for one, which is not done here otherwise. Once it gives ``None``, none are kept any
    more. ``digests_of`` tells of which connections they are kept.

    Attributes:
        make_packet: a new message with default values, for a type in ROS notation.
    """

    def __init__(
        self,
        file: NodeFile,
        hub: MemoryHub,
        bridge: GraphBridge,
        digest: Callable[[Any], int | None] | None = None,
        digests_of: Callable[[Connection], bool] = lambda _: True,
    ) -> None:
        self._name = file.node.name
        self._loop = hub.loop
        self._arrivals = hub.arrivals[file.node.name]
        self._connections = file.connections
        self._hub = hub
        self._bridge = bridge
        self._is_open = False
        self._given_up: list[Any] = []
        self._digest = digest
        elsewhere = [c for c in file.connections if c.source_node != c.destination_node]
        digested = [c for c in elsewhere if digest is not None and digests_of(c)]
        self.digests = {c: array("Q") for c in digested}
        self.make_packet = bridge.make_packet
        hub.received |= {c: d for c, d in self.digests.items() if c.source_node != self._name}
        self._channels = {
            c: _Channel(hub, c) for c in file.connections if c.source_node == self._name
        }
        self._ways_back = {
            c: _WayBack(hub, c) for c in elsewhere if c.destination_node == self._name
        }

    def open(self, inbox: Inbox) -> None:
        """Join the others."""
        self._is_open = True
        self._bridge.open(inbox)
        self._hub.join(self._name, inbox, self._connections)

    def note_result(self, box: Sequence[Any]) -> None:
        """Remember which packets of a hook's result the plugin does not hold any more."""
        self._given_up = unheld(box)

    def send(self, connections: Sequence[Connection], packet: Any) -> None:
        """Give each receiver a copy, but the last one the packet itself if it is unshared.

        It returns nothing, since nothing is serialised.
        """
        if not self._is_open:
            return
        if self._digest is not None and self.digests:
            self._note_digest([c for c in connections if c in self.digests], packet)
        last = connections[-1]
        for connection in connections[:-1]:
            self._channels[connection].send(self._hub.copy(packet))
        own = packet if self._is_unshared(packet) else self._hub.copy(packet)
        self._channels[last].send(own)
        if self._bridge.heard:
            self._bridge.show(connections, packet)

    def send_external(self, port: Port, packet: Any) -> None:
        """Publish on the external topic of an output."""
        self._bridge.send_external(port, packet)

    def acknowledge(self, connection: Connection, position: int) -> None:
        """Tell the sender which position every taker has reached."""
        if self._is_open:
            self._ways_back[connection].send(position)

    def note_execution(self) -> None:
        """A hook has ended: what is on its way here comes before the next one."""
        self._arrivals.first = self._arrivals.sent
        self._loop.note_execution()

    def has_taken_in(self) -> bool:
        """Whether all has arrived that was on its way when the last hook of the node ended."""
        return self._arrivals.arrived >= self._arrivals.first and self._loop.has_taken_in

    def waiting_for(self) -> Sequence[Connection]:
        """Connections whose other end has not joined yet."""
        joined = self._hub.inboxes
        return [
            c
            for c in self._connections
            if c.source_node not in joined or c.destination_node not in joined
        ]

    def close(self) -> None:
        """Send and receive nothing any more."""
        self._is_open = False
        self._given_up = []
        self._hub.leave(self._name)
        self._bridge.close()

    def _note_digest(self, connections: Sequence[Connection], packet: Any) -> None:
        if not connections or self._digest is None:
            return
        digest = self._digest(packet)
        if digest is None:
            self._forget_digests()
            return
        for connection in connections:
            self.digests[connection].append(digest)
            self._channels[connection].announce(digest)

    def _forget_digests(self) -> None:
        """Keep none of what this node sends; half of them would be of no use."""
        self._digest = None
        for connection, channel in self._channels.items():
            if connection in self.digests:
                channel.forget_digests()
                del self.digests[connection][:]
                del self._hub.received[connection][:]

    def _is_unshared(self, packet: Any) -> bool:
        """Whether the hook gave the packet up, and no part of it is held anywhere."""
        for place, given_up in enumerate(self._given_up):
            if given_up is packet:
                del self._given_up[place]  # it is the receiver's from now on
                return is_unshared_inside(packet)
        return False


class _Arrivals:
    """The packets and acknowledgements for one node, each of them an event in the loop.

    Attributes:
        sent: how many have been sent so far, but for packets that were lost in transport.
        arrived: how many of them have arrived.
        first: how many come before the next hook: those sent until the last one had ended.
    """

    __slots__ = ("arrived", "first", "sent")

    def __init__(self) -> None:
        self.sent = self.arrived = self.first = 0


class _Nobody:
    """Takes the place of a node that has left."""

    def on_packet(self, connection: Connection, packet: Any) -> None: ...
    def on_external_packet(self, port: Port, packet: Any) -> None: ...
    def on_acknowledgement(self, connection: Connection, position: int) -> None: ...
    def on_registered(self, connection: Connection) -> None: ...


class _Channel:
    """Packets on their way on one connection: the last K + N packets, as a DDS reader keeps them.

    A sender without acknowledgements (BEST_EFFORT) may be faster than its receiver for ever; what
    no longer fits is lost in transport, and the loop's queue stays short.
    """

    __slots__ = ("_arrivals", "_connection", "_digests", "_hub", "_packets", "_window")

    def __init__(self, hub: MemoryHub, connection: Connection) -> None:
        self._hub = hub
        self._connection = connection
        self._window = connection.window
        self._packets: deque[Any] = deque(maxlen=self._window)
        self._arrivals = hub.arrivals[connection.destination_node]
        self._digests: deque[int] = deque(maxlen=connection.window)

    def announce(self, digest: int) -> None:
        """The digest of the packet that is sent next."""
        self._digests.append(digest)

    def forget_digests(self) -> None:
        """None are kept of the packets under way."""
        self._digests.clear()

    def send(self, packet: Any) -> None:
        if len(self._packets) < self._window:  # else an event is on its way for one that is lost
            self._arrivals.sent += 1
            self._hub.post(self._deliver)
        self._packets.append(packet)

    def _deliver(self) -> None:
        if self._digests:
            self._hub.received[self._connection].append(self._digests.popleft())
        self._arrivals.arrived += 1
        connection = self._connection
        inbox = self._hub.inboxes[connection.destination_node]
        inbox.on_packet(connection, self._packets.popleft())


class _WayBack:
    """The acknowledgements that are on their way on one connection."""

    __slots__ = ("_arrivals", "_connection", "_hub", "_positions")

    def __init__(self, hub: MemoryHub, connection: Connection) -> None:
        self._hub = hub
        self._connection = connection
        self._positions: deque[int] = deque()
        self._arrivals = hub.arrivals[connection.source_node]

    def send(self, position: int) -> None:
        self._arrivals.sent += 1
        self._positions.append(position)
        self._hub.post(self._deliver)

    def _deliver(self) -> None:
        self._arrivals.arrived += 1
        connection = self._connection
        inbox = self._hub.inboxes[connection.source_node]
        inbox.on_acknowledgement(connection, self._positions.popleft())
