"""A node in a process or container of its own, in virtual time, joined to the others by ROS.

It is :mod:`neuros.runtime.virtual` with one node, whose events wait until its horizon lets them
(:mod:`neuros.engine.horizon`). Packets are those of real time. When they arrive in virtual time
stands in the states of nodes, and so do acknowledgements. States travel on a topic for each pair
of neighbours, ``/neuros/<node>/virtual_time/<neighbour>``, as MessagePack in a latched
``std_msgs/msg/UInt8MultiArray``. Each message has all that the node knows, so that only the newest
one counts. Where packets go to the neighbour, too, the last of them carries the states, unless
others read its topic.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from heapq import heappop
from typing import Any

import msgspec
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.timer import Timer
from std_msgs.msg import UInt8MultiArray

from neuros.engine.horizon import (
    END_NS,
    NEVER_NS,
    Answer,
    Channel,
    Ending,
    Horizon,
    KnownState,
    Moment,
)
from neuros.ports import Inbox, Transport
from neuros.project.model import Connection, NodeFile
from neuros.project.names import INTERNAL
from neuros.project.timing import LEAST_DELAY_NS
from neuros.runtime.local import Event
from neuros.runtime.virtual import DRAIN_S, NodeTime, OneWay, VirtualLoop
from neuros.transport.codecs import HEADER
from neuros.transport.lean_node import LeanNode
from neuros.transport.ros import ReceivingLink, RosTransport, SendingLink
from neuros.transport.ros_loop import RosLoop
from neuros.transport.ros_process import RosProcess, RosTransportKind
from neuros.transport.schema import schema

_TURN_NS = 1_000_000
"""How long events of the node may keep those of ROS waiting, besides the hook that runs."""

_TELL_ALL_S = 0.2
"""How often a node tells all that is new, also what nobody waits for, such as that all are idle."""

_ARRAY = struct.Struct("<4sIII")
"""A ``std_msgs/msg/UInt8MultiArray`` in little-endian CDR, up to its bytes: no dimensions."""

_STATED_MARK = b"NV"
"""Option bytes of the encapsulation header of a packet that carries states."""

_STATED = struct.Struct("<2s2sI")
"""Before a packet that carries states: representation, mark, and the size of the states."""

_ALIGNMENT = 8
"""Of the packet behind the states, in bytes."""

_PATIENCE_S = 0.002
"""How long a node waits before it asks a neighbour that sends much, by the clock of the machine."""

_ALL = QoSProfile(
    history=QoSHistoryPolicy.KEEP_ALL,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.VOLATILE,
)
"""QoS of packets and acknowledgements: what is lost, the clock of the run decides."""

# Only the newest state counts, but with a depth of 1 a state that takes the place of one that is
# not acknowledged yet would wait for the next heartbeat of DDS, a second or more.
_NEWEST = QoSProfile(
    depth=256,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
)


class RosNodeTime(NodeTime):
    """The clock and the events of the node of a process."""

    _loop: RosVirtualLoop

    @property
    def waits_for(self) -> str:  # type: ignore[override]
        """The node that this one waits for, and both their times. Any thread."""
        return self._loop.why_waiting

    def announce(self, duration_ns: int) -> None:
        if duration_ns or self._loop.horizon.has_sent:
            self._loop.tell(self.now_ns + duration_ns)

    def watch(self, awaited: Callable[[], Sequence[Connection]]) -> None:
        self._loop.awaited = awaited

    def step(self, time_ns: int) -> None:
        # An acknowledgement that comes late changes nothing: as if it had come in time.
        while self._events and self._events[0][0] < self.instant_ns:
            heappop(self._events)[-1]()
        if self.next_ns is not None and self.next_ns <= time_ns:
            self._loop.horizon.handle(time_ns)
            super().step(time_ns)

    @property
    def must_look(self) -> bool:  # type: ignore[override]
        return len(self._loop.find_awaited()) > 0

    def hold(self, duration_ns: int) -> None:
        super().hold(duration_ns)
        if duration_ns:
            self.post_loop_back(_end_of_hold)

    def ready(self) -> None:
        self._loop.is_ready = True

    def at_zero(self, event: Event, first_pass: Event) -> None:
        def begin() -> None:
            event()
            self.post(first_pass)

        self._loop.at_zero(begin)

    def drain(self, event: Event, stop: Event, *, is_asked: bool) -> None:
        self._loop.drain_when_known(partial(super().drain, event, stop, is_asked=True), is_asked)


class RosVirtualLoop(VirtualLoop):
    """Runs the node of a process up to its horizon, in the loop that serves ROS.

    Attributes:
        horizon: of the node.
        publish: publishes states, encoded, for a neighbour.
        awaited: connections whose acknowledgements could change which hooks start.
        is_ready: whether the node has run its initialise hooks.
        why_waiting: which node keeps this one from its next event; empty if none does.
        patience: calls :meth:`lose_patience`, once it is reset.
    """

    def __init__(self, seed: str, ros: RosLoop) -> None:
        super().__init__(seed)
        self._ros_loop = ros
        self.horizon: Horizon
        self.publish: Callable[[str, bytes], None]
        self.awaited: Callable[[], Sequence[Connection]] = list
        # By channel of acknowledgements, what takes in one that has arrived.
        self.answers: dict[int, Callable[[Answer], None]] = {}
        self.is_ready = False
        self.why_waiting = ""
        self._has_posted = False
        # By connection, what has come, and whose time of arrival is not known yet.
        self._arrived: dict[Connection, deque[Event]] = {}
        # By neighbour, packets that leave with the next states.
        self._leaving: dict[str, list[tuple[VirtualSendingLink, bytes]]] = {}
        self._waits_ns = -1
        self.patience: Timer
        self._is_patient_for: int | None = None  # the time of the event that it waits for
        self._at_zero: Event | None = None
        self._drain: Event | None = None  # what a node does when the end reaches it
        self._is_draining = self._is_stepped = False

    # ------------------------------------------------------------------ what the node asks for

    def at_zero(self, event: Event) -> None:
        """Handle an event at time 0 of the run, which is the same for all nodes."""
        self._at_zero = event
        self._wake()

    def go_on(self, *, is_stepped: bool) -> None:
        self._is_stepped = is_stepped
        self.horizon.let_go(self.now_ns)

    def drain_when_known(self, drain: Event, is_asked: bool) -> None:
        """Drain at the time of the end, which another node may have asked for."""
        self._drain = drain
        if not is_asked and self._end is None:
            self.end("", DRAIN_S)
        self._wake()

    def drain(self, name: str, stop: Event) -> int:
        self._is_draining = True
        return super().drain(name, stop)

    def plan(self, duration_s: float | None, on_end: Event, real_time_factor: float | None) -> None:
        def end() -> None:
            assert self.limit_ns is not None
            self._end = self.limit_ns, "", round(DRAIN_S * 1e9)
            on_end()

        super().plan(duration_s, end, real_time_factor)

    @property
    def has_waiting_events(self) -> bool:
        # What a neighbour has not handled counts at its sender: no probe sees it under way.
        is_under_way = self._drain is not None or self.horizon.is_under_way
        return is_under_way or super().has_waiting_events

    # ------------------------------------------------------------------ what arrives

    def arrive(self, connection: Connection, event: Event) -> None:
        """A packet has come: handle it when its time has."""
        self._arrived.setdefault(connection, deque()).append(event)
        if self.horizon.arrival_ns(_packets(connection)) is not None:
            self._wake()

    def learn(self, states: Sequence[KnownState]) -> None:
        """States of nodes have come."""
        for answer in self.horizon.learn(states):
            self.answers[answer.channel](answer)
        ending = self.horizon.ending()
        if (
            ending is not None
            and not self._is_draining
            and (self._end is None or ending < Ending(*self._end))
        ):
            self._end, self._tell_end = (ending.time_ns, ending.node, ending.drain_ns), None
            late_ns = END_NS if ending.node else 0
            self.limit_ns, self._on_limit = ending.time_ns + late_ns, []
        self._wake()

    # ------------------------------------------------------------------ running

    def run(self) -> None:
        self._wake()
        self._ros_loop.run()

    def stop(self) -> None:
        super().stop()
        self._ros_loop.stop()

    def post_from_thread(self, event: Event) -> None:
        super().post_from_thread(event)
        self._ros_loop.post_from_thread(self._wake)

    def step(self) -> bool:
        for connection, events in self._arrived.items():
            channel = _packets(connection)
            while events and (arrival_ns := self.horizon.arrival_ns(channel)) is not None:
                number = self.horizon.receive(channel)
                self._nodes[0].arrive(arrival_ns, connection.index, number, events.popleft())
        if self._at_zero is not None:
            zero_ns = self.horizon.zero_ns(self._moment())
            if zero_ns is not None:
                event, self._at_zero = self._at_zero, None
                self._nodes[0].wait_until(zero_ns)
                self.now_ns = zero_ns
                self.horizon.let_go(zero_ns)
                event()
                return True
        if self._drain is not None and self._end is not None:
            drain, self._drain = self._drain, None
            drain()
            return True
        return super().step()

    def send(self, link: VirtualSendingLink, target: str, data: bytes) -> None:
        """Publish a packet for a neighbour with the next states, which tell when it arrives."""
        self._leaving.setdefault(target, []).append((link, data))

    def tell(self, free_ns: int | None = None, *, is_patient: bool = True) -> None:
        """Tell the neighbours the state of the node, as far as they may wait for it.

        Args:
            free_ns: when the hook that starts now ends; ``None``: none starts now.
            is_patient: whether to ask only neighbours that tell nothing unasked.
        """
        self._publish(self.horizon.news(self._moment(free_ns), is_patient=is_patient))
        if self.horizon.withholds and self._is_patient_for is None:
            self._is_patient_for = self._waits_ns
            self.patience.reset()

    def tell_all(self) -> None:
        """Tell the neighbours all that is new."""
        if self._nodes:
            self._publish(self.horizon.news(self._moment(), is_all=True))

    def _publish(self, news: Iterable[tuple[str, list[KnownState]]]) -> None:
        for name, states in news:
            *packets, last = self._leaving.pop(name, ()) or (None,)
            for link, data in packets:
                link.publish_with(data, b"")
            encoded = msgspec.msgpack.encode(states)
            if last is None or not last[0].publish_with(last[1], encoded):
                self.publish(name, encoded)

    def lose_patience(self) -> None:
        """Ask the neighbours that the node still waits for."""
        self.patience.cancel()
        is_same, self._is_patient_for = self._is_patient_for == self._waits_ns, None
        self.tell(is_patient=not is_same)

    def find_awaited(self) -> Sequence[int]:
        """The channels of acknowledgements that could change what the node does."""
        return [_positions(connection) for connection in self.awaited()]

    def _make_node(self, name: str, place: int) -> NodeTime:
        return RosNodeTime(self, name, place)

    def _is_first(self, time_ns: int) -> bool:
        causes = self.horizon.behind(time_ns)
        self._waits_ns = time_ns if causes else -1
        return not causes

    def _can_go_on(self) -> bool:
        return not self.horizon.is_behind and super()._can_go_on()

    def _may_handle(self, time_ns: int) -> bool:
        if self.horizon.is_behind:
            return False
        other = self.horizon.waits_for(time_ns, self.find_awaited())
        self._waits_ns = time_ns if other else -1
        self.why_waiting = ""
        if other:
            self.why_waiting = (
                f"waits in virtual time, at {(time_ns - self.zero_ns) / 1e9:g} s, for what node"
                f" '{other}' may still send before"
            )
        return not other

    @property
    def _comes_to_rest(self) -> bool:
        return self._is_stepped or self._end is not None

    def _moment(self, free_ns: int | None = None) -> Moment:
        node = self._nodes[0]
        if free_ns is None:
            free_ns = node.now_ns if node.now_ns > node.instant_ns else -1
        next_ns = node.next_ns
        return Moment(
            node.instant_ns,
            NEVER_NS if next_ns is None else next_ns,
            free_ns,
            *((self._waits_ns, tuple(self.horizon.causes)) if self._waits_ns >= 0 else (-1, ())),
            # Where the run is to come to rest, all acknowledgements count: none is left then.
            tuple(self.answers if self._comes_to_rest else self.find_awaited()),
            self.is_ready,
            self.zero_ns if self.has_begun else -1,
            self.horizon.rounds,
            None if self._end is None else Ending(*self._end),
        )

    def _wake(self) -> None:
        if not self._has_posted:
            self._has_posted = True
            self._ros_loop.post_loop_back(self._advance)

    def _advance(self) -> None:
        self._has_posted = False
        end_ns = time.monotonic_ns() + _TURN_NS
        while self.step():
            # All of an instant, and the end of a hook, come before states that others wait for.
            node = self._nodes[0]
            if time.monotonic_ns() > end_ns and node.next_ns != node.now_ns:
                self._wake()
                break
        else:
            if self._loop_back():
                self._wake()
        if self._is_draining or self._is_stepped:
            self.tell_all()
        else:
            self.tell()


class VirtualSendingLink(SendingLink):
    """One connection at its sender, in virtual time."""

    def __init__(self, *positional: Any) -> None:
        super().__init__(*positional)
        self._states = b""
        # DDS reserves the largest size that a type with bounds can have, and takes no more.
        *_, publisher = positional
        leaves = schema(publisher.msg_type).leaves
        self._has_room = any(leaf.field.is_unbounded for leaf in leaves)
        self._publish_raw, self.publish = self.publish, self._publish_outermost

    def open_in(self, loop: RosVirtualLoop, node_time: NodeTime) -> None:
        """The receiver is there: from now on packets get their times of arrival."""
        self._loop, self._time = loop, node_time
        self._direction = OneWay(loop.seed, "delay", self._connection)
        self._publish, self.publish = self.publish, self._send
        loop.answers[_positions(self._connection)] = self._take

    def _take(self, answer: Answer) -> None:
        _, number, arrival_ns, position = answer
        event = partial(self._inbox.on_acknowledgement, self._connection, position, arrival_ns)
        self._time.arrive(arrival_ns, self._connection.index, number, event)

    def _send(self, data: bytes) -> None:
        way = self._direction.send(self._time.now_ns)
        if way is None:
            self._time.lose(self._connection)
        else:
            self._loop.horizon.send(_packets(self._connection), way[0])
            self._loop.send(self, self._connection.destination_node, data)

    def publish_with(self, data: bytes, states: bytes) -> bool:
        """Publish a packet; returns whether it carries the states, which no other reader knows."""
        can_carry = self._has_room and len(states) > 0 and self.count_readers() == 1
        self._states = states if can_carry else b""
        self._publish(data)
        return can_carry

    def _publish_outermost(self, data: bytes) -> None:
        if self._states:
            size = len(self._states)
            head = _STATED.pack(HEADER[:2], _STATED_MARK, size)
            data = b"".join((head, self._states, b"\0" * (-size % _ALIGNMENT), data))
        self._publish_raw(data)


class VirtualReceivingLink(ReceivingLink):
    """One connection at its receiver, in virtual time."""

    def __init__(
        self, loop: RosVirtualLoop, node_time: NodeTime, connection: Connection, *more: Any
    ) -> None:
        super().__init__(connection, *more)
        self._connection = connection
        self._loop, self._time = loop, node_time
        self._direction = OneWay(loop.seed, "acknowledgement", connection)

    def receive(self, data: bytes) -> None:
        packet = self._decode(data) if self.is_open else None
        if packet is not None:
            event = partial(self._arrive, packet, self._digest(data, packet))
            self._loop.arrive(self._connection, event)

    def acknowledge(self, position: int) -> None:
        if self.is_open and self._connection.is_reliable:
            way = self._direction.send(self._time.now_ns)
            assert way is not None  # no acknowledgement is lost
            self._loop.horizon.send(_positions(self._connection), way[0], position)

    def _arrive(self, packet: Any, digest: int) -> None:
        if self.is_open:
            self._digests.append(digest)
            self._deliver(packet)


class RosVirtualTransport(RosTransport):
    """Carries the packets of one node over ROS topics, each with its time of arrival."""

    _make_sending_link = VirtualSendingLink

    def __init__(self, file: NodeFile, ros_node: LeanNode, ros: RosLoop, loop: RosVirtualLoop):
        super().__init__(file, ros_node, ros)
        self._virtual = loop
        self._time = loop.of(file.node.name)
        self.has_taken_in = self._time.has_taken_in  # type: ignore[method-assign]
        self._make_receiving_link = partial(VirtualReceivingLink, loop, self._time)
        name, inward, outward = file.node.name, {}, []
        for c in file.connections:
            delay_ns = max(LEAST_DELAY_NS, c.delay.least_ns)
            if c.source_node == c.destination_node:
                continue
            if c.source_node == name:
                outward.append(Channel(_packets(c), c.destination_node, delay_ns))
                if c.is_reliable:
                    inward[_positions(c)] = c.destination_node
            else:
                inward[_packets(c)] = c.source_node
                if c.is_reliable:
                    outward.append(Channel(_positions(c), c.source_node, delay_ns, c.window))
        loop.horizon = Horizon(name, inward, outward)
        namespace = file.names.namespace
        publishers = {}
        for other in loop.horizon.neighbours:
            topic = _topic(namespace, name, other)
            publishers[other] = ros_node.create_publisher(UInt8MultiArray, topic, _NEWEST)
            ros_node.create_subscription(
                UInt8MultiArray,
                _topic(namespace, other, name),
                ros.guarded(lambda data: loop.learn(_states_in(data))),
                _NEWEST,
                raw=True,
            )
        loop.publish = lambda other, states: _publish(publishers[other], states)
        ros.every(ros_node, _TELL_ALL_S, loop.tell_all)
        # A timer of ROS: for one of the loop, the executor would be left and entered each time.
        loop.patience = ros.every(ros_node, _PATIENCE_S, loop.lose_patience)
        loop.patience.cancel()

    def _unwrapping(self, deliver: Callable[[bytes], None]) -> Callable[[bytes], None]:
        def receive(data: bytes) -> None:
            if data[2:4] != _STATED_MARK:
                deliver(data)
                return
            end = _STATED.size + _STATED.unpack_from(data)[-1]
            deliver(data[end + -end % _ALIGNMENT :])
            self._virtual.learn(_DECODER.decode(data[_STATED.size : end]))

        return receive

    def _data_qos(self, connection: Connection, *, is_reader: bool = False) -> QoSProfile:
        return _ALL

    def _position_qos(self, *, is_reader: bool) -> QoSProfile:
        return _ALL

    def _on_receiver_found(self, connection: Connection, note: str, inbox: Inbox) -> None:
        # Memory that both share is used again for newer packets where none is acknowledged.
        self._prepare(connection, note if connection.is_reliable else "")
        link = self._sending[connection]
        assert isinstance(link, VirtualSendingLink)
        link.open_in(self._virtual, self._time)
        self._time.post(partial(inbox.on_registered, connection))

    def note_execution(self) -> None:
        """Nothing: see :class:`NodeTime`."""


class RosVirtualProcess(RosProcess):
    """ROS in a process whose node is in virtual time (:class:`neuros.ports.Middleware`)."""

    def __init__(
        self, files: Sequence[NodeFile], on_failure: Callable[[BaseException], None], **more: Any
    ) -> None:
        super().__init__(files, on_failure, **more)
        self.loop = self.virtual = RosVirtualLoop(files[0].seed, self.ros_loop)

    def transport(self, file: NodeFile) -> Transport:
        transport = RosVirtualTransport(file, self.ros_node(file), self.ros_loop, self.virtual)
        self._transports.append(transport)
        return transport

    def take_in(self) -> None:
        super().take_in()
        self.virtual.take_in()

    def loop_of(self, file: NodeFile) -> NodeTime:
        return self.virtual.of(file.node.name)


class _VirtualRos(RosTransportKind):
    """``virtual-ros``: nodes in processes of their own, or in containers, in virtual time."""

    name = "virtual-ros"
    process = RosVirtualProcess


VIRTUAL_ROS = _VirtualRos()

_DECODER = msgspec.msgpack.Decoder(list[KnownState])


def _end_of_hold() -> None:
    """An event at the end of a hook: then the neighbours learn that the node is free."""


def _publish(publisher: Publisher, states: bytes) -> None:
    publisher.handle.publish_raw(_ARRAY.pack(HEADER, 0, 0, len(states)) + states)


def _states_in(data: bytes) -> list[KnownState]:
    *_, size = _ARRAY.unpack_from(data)
    return _DECODER.decode(data[_ARRAY.size : _ARRAY.size + size])


def _topic(namespace: str, source: str, target: str) -> str:
    return f"{namespace}{INTERNAL}{source}/virtual_time/{target}"


def _packets(connection: Connection) -> int:
    """The channel of the packets of a connection."""
    return 2 * connection.index


def _positions(connection: Connection) -> int:
    """The channel of its acknowledgements."""
    return 2 * connection.index + 1
