"""The ROS 2 transport: packets of a node over topics, and the registration of its connections.

A connection has three topics below ``/neuros/<source>/<output>/<destination>/<input>``: ``/data``,
``/ack`` (the position of the last packet that every hook of the receiver has started on), and
``/reg``. The log names strangers that publish there
(:class:`neuros.transport.ros_graph.StrangerCheck`).
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from rclpy.node import Node as RosNode
from rclpy.publisher import Publisher
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_msgs.msg import String, UInt64

from neuros.ports import Inbox
from neuros.project.model import Connection, NodeFile, Port
from neuros.transport.codecs import HEADER, PARCEL_MARK, Codec, Decoder, Encoder, message_codec
from neuros.transport.digests import Digest, digest_for, digest_of_bytes, make_digests
from neuros.transport.envelope import Compressor, Traffic, compressing, decompressing
from neuros.transport.large_packets import LargeCodecs, machine_token
from neuros.transport.messages import message_class, packet_kind
from neuros.transport.ros_graph import ExternalTopics, StrangerCheck, data_qos, is_compatible
from neuros.transport.ros_loop import RosLoop

_ANNOUNCE_S = 0.02

_POSITION = struct.Struct("<4sQ")
"""A ``std_msgs/msg/UInt64`` in little-endian CDR: the header, and the position."""


class SendingLink:
    """One connection at its sender: all that its packets and their acknowledgements pass.

    Attributes:
        codec: makes bytes of packets; a better one takes its place when the receiver is known.
        digests: of the packets sent.
        publish: publishes what the codec makes.
        count_readers: returns the number of all subscriptions to the data topic.
        carries_message: whether the codec makes the packet as ROS serialises it.
    """

    def __init__(
        self,
        connection: Connection,
        inbox: Inbox,
        codec: Encoder,
        digest: Digest,
        digests: array[int],
        publisher: Publisher,
    ) -> None:
        self._connection = connection
        self._inbox = inbox
        self.codec = codec
        self.digest = digest
        self.digests = digests
        self.publish: Callable[[bytes], None] = publisher.handle.publish_raw
        self.count_readers: Callable[[], int] = publisher.get_subscription_count
        self.carries_message = not connection.is_jpeg
        self.is_open = True

    def receive_position(self, data: bytes) -> None:
        """Hand over the position that every hook has reached."""
        if self.is_open:
            self._inbox.on_acknowledgement(self._connection, position_of(data))


class ReceivingLink:
    """One connection at its receiver: all that its packets and their acknowledgements pass.

    Args:
        digests: of the packets received.
        publisher: of acknowledgements, ``None`` on a connection without.
    """

    def __init__(
        self,
        connection: Connection,
        inbox: Inbox,
        codec: Decoder,
        digest: Digest,
        digests: array[int],
        publisher: Publisher | None,
    ) -> None:
        self._deliver = partial(inbox.on_packet, connection)
        self._decode = codec.decode
        self._digest = digest
        self._digests = digests
        self._publish = None if publisher is None else publisher.handle.publish_raw
        self.is_open = True

    def receive(self, data: bytes) -> None:
        """Deliver the packet that was published, unless it was lost on its way."""
        if self.is_open and (packet := self._decode(data)) is not None:
            self._digests.append(self._digest(data, packet))
            self._deliver(packet)

    def acknowledge(self, position: int) -> None:
        """Publish the position that every hook has reached."""
        if self.is_open and self._publish is not None:
            self._publish(_POSITION.pack(HEADER, position))


def _way(connection: Connection, port: Port, traffic: Traffic) -> tuple[type, Codec, Digest]:
    """Class of the messages on the data topic of a connection, codec and digest of its packets."""
    if connection.is_jpeg:
        from neuros.transport import jpeg  # brings all messages of cameras along

        return jpeg.KIND, jpeg.JpegCodec(connection.quality, traffic), digest_of_bytes
    kind = packet_kind(port.type)
    return message_class(port.type), message_codec(kind), digest_for(kind)


def position_of(data: bytes) -> int:
    """The position in an acknowledgement. Raises ``WrongBytes``."""
    if len(data) == _POSITION.size and data[:4] == HEADER:
        position: int = _POSITION.unpack(data)[1]
    else:  # the byte order of another machine
        position = message_codec(UInt64).decode(data).data
    return position


_LATCHED = QoSProfile(
    depth=1,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
)
"""QoS of the writers of ``/reg`` and ``/ack``: the last message also reaches later readers."""

_LATCHED_READER = QoSProfile(
    history=QoSHistoryPolicy.KEEP_ALL,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
)
"""QoS of the readers of ``/reg`` and ``/ack``: messages of strangers replace none."""

_READY = "ready"
_CONFIRMED = "confirmed"


class RosTransport:
    """Carries the packets of one node over ROS topics (:class:`neuros.ports.Transport`)."""

    def __init__(self, file: NodeFile, ros_node: RosNode, loop: RosLoop) -> None:
        self._node = file.node
        self._connections = file.connections
        self._ros_node = ros_node
        self._loop = loop
        self.note_execution = loop.note_execution
        self._sending: dict[Connection, SendingLink] = {}
        self._receiving: dict[Connection, ReceivingLink] = {}
        self._external = ExternalTopics(file, ros_node, loop)
        self.digests = make_digests(file.connections)
        self._traffic: dict[str, Traffic] = {}
        self._compressors: dict[str, Compressor] = {}
        self._strangers = StrangerCheck(ros_node, loop)
        self._registrations: list[Registration] = []
        self._large = LargeCodecs(file, ros_node.get_logger().warning)
        self._is_open = False

    def open(self, inbox: Inbox) -> None:
        """Create all endpoints and look for the other ends until each is found."""
        self._is_open = True
        for connection in self._connections:
            if connection.source_node == connection.destination_node:
                self._loop.post(partial(inbox.on_registered, connection))
            elif connection.source_node == self._node.name:
                self._open_sender(connection, inbox)
            else:
                self._open_receiver(connection, inbox)
        self._external.open(inbox)
        if self._registrations:
            self._loop.expect_arrivals()
            self._timer = self._loop.every(self._ros_node, _ANNOUNCE_S, self._advance_registrations)

    def sender(self, connections: Sequence[Connection]) -> Callable[[Any], bytes | None]:
        """Return what publishes a packet on these data topics, serialised once.

        It returns the bytes where it was serialised as a whole message.
        """
        links = [self._sending[connection] for connection in connections]

        def send(packet: Any) -> bytes | None:
            if not self._is_open:
                return None
            whole = None
            encoded: dict[Encoder, tuple[bytes, int]] = {}
            for link in links:
                found = encoded.get(link.codec)
                if found is None:
                    data = link.codec.encode(packet)
                    found = encoded[link.codec] = (data, link.digest(data, packet))
                    if link.carries_message and data[2:4] != PARCEL_MARK:
                        whole = data
                link.publish(found[0])
                link.digests.append(found[1])
            return whole

        return send

    def send_external(self, port: Port, packet: Any) -> None:
        if self._is_open:
            self._external.send(port, packet)

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        return self._receiving[connection].acknowledge

    @property
    def compressed(self) -> Mapping[str, tuple[int, int]]:
        return {name: (each.bytes, each.compressed_bytes) for name, each in self._traffic.items()}

    def give_way(self) -> None:
        """No other node is in this process."""

    def has_taken_in(self) -> bool:
        return self._loop.has_taken_in

    def waiting_for(self) -> Sequence[Connection]:
        return [each.connection for each in self._registrations if not each.is_done]

    def close(self) -> None:
        """Publish and receive nothing any more; the endpoints go with their ROS node."""
        self._is_open = False
        links: list[SendingLink | ReceivingLink] = [
            *self._sending.values(),
            *self._receiving.values(),
        ]
        for link in links:
            link.is_open = False
        self._strangers.close()
        self._external.close()
        self._large.close()

    def _open_sender(self, connection: Connection, inbox: Inbox) -> None:
        traffic, port = Traffic(), self._node.output(connection.source_output)
        kind, codec, digest = _way(connection, port, traffic)
        if connection.is_jpeg:
            self._traffic[str(connection)] = traffic
        elif connection.is_zstd:
            self._compressors.setdefault(connection.source_output, Compressor())
        data = self._ros_node.create_publisher(
            kind, f"{connection.topic}/data", self._data_qos(connection)
        )
        link = self._sending[connection] = self._make_sending_link(
            connection, inbox, codec, digest, self.digests[connection], data
        )
        subscriptions = []
        if connection.is_reliable:
            qos = self._position_qos(is_reader=True)
            subscriptions.append(
                self._subscribe(UInt64, connection, "ack", qos, link.receive_position)
            )
        self._registrations.append(
            Registration(
                self._ros_node,
                connection,
                publishers=[data],
                subscriptions=subscriptions,
                is_sender=True,
                strangers=self._strangers,
                on_registered=lambda note: self._loop.post(
                    partial(self._on_receiver_found, connection, note, inbox)
                ),
            )
        )

    def _open_receiver(self, connection: Connection, inbox: Inbox) -> None:
        port = self._node.input(connection.destination_input)
        kind, codec, digest = _way(connection, port, Traffic())
        publishers = []
        if connection.is_reliable:
            qos = self._position_qos(is_reader=False)
            publishers.append(
                self._ros_node.create_publisher(UInt64, f"{connection.topic}/ack", qos)
            )
        link = self._receiving[connection] = self._make_receiving_link(
            connection,
            inbox,
            codec if connection.is_jpeg else self._large.decoder(connection),
            digest,
            self.digests[connection],
            publishers[0] if publishers else None,
        )
        receive = decompressing(link.receive) if connection.is_zstd else link.receive
        data = self._subscribe(
            kind, connection, "data", self._data_qos(connection, is_reader=True), receive
        )
        self._registrations.append(
            Registration(
                self._ros_node,
                connection,
                publishers=publishers,
                subscriptions=[data],
                is_sender=False,
                strangers=self._strangers,
                note=self._large.note(connection),
                on_registered=lambda _: None,
            )
        )

    # What differs in virtual time (:mod:`neuros.runtime.virtual_ros`).
    _make_sending_link: Callable[..., SendingLink] = SendingLink
    _make_receiving_link: Callable[..., ReceivingLink] = ReceivingLink
    _data_qos = staticmethod(data_qos)

    def _position_qos(self, *, is_reader: bool) -> QoSProfile:
        return _LATCHED_READER if is_reader else _LATCHED

    def _unwrapping(self, deliver: Callable[[bytes], None]) -> Callable[[bytes], None]:
        return deliver

    def _on_receiver_found(self, connection: Connection, note: str, inbox: Inbox) -> None:
        """A receiver is there, and has sent ``note`` with its registration."""
        self._prepare(connection, note)
        inbox.on_registered(connection)

    def _prepare(self, connection: Connection, note: str) -> None:
        """Choose the codec for the receiver."""
        link = self._sending[connection]
        if connection.is_jpeg:
            return
        link.codec = self._large.encoder(connection, note, link.count_readers) or link.codec
        if connection.is_zstd and (not note or note != machine_token()):
            link.publish = compressing(
                self._compressors[connection.source_output],
                self._traffic.setdefault(str(connection), Traffic()),
                link.count_readers,
                link.publish,
            )

    def _subscribe(
        self,
        kind: type,
        connection: Connection,
        part: str,
        qos: QoSProfile,
        deliver: Callable[[bytes], None],
    ) -> Subscription:
        """Subscribe to serialised messages."""
        topic = f"{connection.topic}/{part}"
        writer = connection.source_node if part == "data" else connection.destination_node
        return self._ros_node.create_subscription(
            kind,
            topic,
            self._loop.guarded(self._unwrapping(deliver)),
            qos,
            event_callbacks=self._strangers.callbacks(connection, topic, writer),
            raw=True,
        )

    def _advance_registrations(self) -> None:
        pending = [each for each in self._registrations if not each.advance()]
        if not pending:
            self._ros_node.destroy_timer(self._timer)


class Registration:
    """One end of a connection until it has found the other end.

    DDS matches a writer and a reader on each side separately and at different times, and packets
    sent before both have matched may be lost without a trace. So each end checks its own endpoints.
    The receiver announces itself on ``/reg`` once its data reader has matched the sender's writer
    and its acknowledgement writer the sender's reader. The sender, once its own endpoints have
    matched and it has received the announcement, counts the connection as registered and confirms.

    A number of matches does not tell the peer from a recorder or ``ros2 topic echo``. The peer
    counts as found when the ROS graph lists an endpoint of that very node, and all
    compatible endpoints that the graph lists are matched.

    Args:
        strangers: names others that publish on ``/reg``.
        note: one line that a receiver sends with its announcement.
        on_registered: called once, in the loop's thread, when this end is sure of the other;
            a sender gets the receiver's note, a receiver an empty one.
    """

    def __init__(
        self,
        ros_node: RosNode,
        connection: Connection,
        *,
        publishers: list[Publisher],
        subscriptions: list[Subscription],
        is_sender: bool,
        strangers: StrangerCheck,
        note: str = "",
        on_registered: Callable[[str], None],
    ) -> None:
        self.connection = connection
        self.is_done = False
        self._ros_node = ros_node
        self._publishers = publishers
        self._subscriptions = subscriptions
        self._is_sender = is_sender
        self._peer = connection.destination_node if is_sender else connection.source_node
        self._on_registered = on_registered
        self._announcement = f"{_READY} {note}"
        self._peer_is_ready = False
        self._peer_note = ""
        topic = f"{connection.topic}/reg"
        self._reg_publisher = ros_node.create_publisher(String, topic, _LATCHED)
        nodes = (connection.source_node, connection.destination_node)
        self._reg_subscription = ros_node.create_subscription(
            String,
            topic,
            self._receive,
            _LATCHED_READER,
            event_callbacks=strangers.callbacks(connection, topic, *nodes),
        )

    def advance(self) -> bool:
        """Announce or confirm if the peer is found; returns whether the end is registered."""
        if self.is_done or not self._has_found_peer():
            return self.is_done
        if not self._is_sender:
            self._publish(self._announcement)
        elif self._peer_is_ready:
            self._publish(_CONFIRMED)
            self._finish()
        return self.is_done

    def _publish(self, text: str) -> None:
        self._reg_publisher.publish(String(data=text))

    def _receive(self, message: String) -> None:
        state, _, note = message.data.partition(" ")
        if self._is_sender and state == _READY:
            self._peer_is_ready = True
            self._peer_note = note
            if self.is_done:  # the receiver may have subscribed after the confirmation
                self._publish(_CONFIRMED)
            else:
                self.advance()
        elif not self._is_sender and state == _CONFIRMED and not self.is_done:
            self._finish()

    def _finish(self) -> None:
        self.is_done = True
        self._on_registered(self._peer_note)

    def _has_found_peer(self) -> bool:
        for publisher in self._publishers:
            # The count comes first: the graph is searched from end to end for each topic.
            matched, own = publisher.get_subscription_count(), publisher.qos_profile
            if not matched:
                return False
            listed = self._ros_node.get_subscriptions_info_by_topic(publisher.topic_name)
            compatible = [each for each in listed if is_compatible(own, each.qos_profile)]
            if not self._is_among(compatible, matched):
                return False
        for subscription in self._subscriptions:
            matched, own = subscription.get_publisher_count(), subscription.qos_profile
            if not matched:
                return False
            listed = self._ros_node.get_publishers_info_by_topic(subscription.topic_name)
            compatible = [each for each in listed if is_compatible(each.qos_profile, own)]
            if not self._is_among(compatible, matched):
                return False
        return True

    def _is_among(self, compatible: Sequence[TopicEndpointInfo], matched: int) -> bool:
        return matched >= len(compatible) and any(e.node_name == self._peer for e in compatible)
