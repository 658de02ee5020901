"""The ROS graph around a node: its external topics, checks of them, and the ROS graph bridge.

External topics are plain ROS topics, with the QoS that the project asks for. A registration proves
each connection between nodes. An external topic has no other end that could confirm, so ROS graph
checks look for two mistakes that nothing else would tell: QoS that does not fit, and silence. A
third check names strangers that publish on the topics of connections. The
bridge gives nodes of one process their place in the ROS graph.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node as RosNode
from rclpy.publisher import Publisher
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSPresetProfiles,
    QoSProfile,
    QoSReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from neuros.ports import Inbox
from neuros.project.model import Connection, NodeFile, Port
from neuros.project.names import SESSION
from neuros.project.qos import ASKED, OFFERED, PRESETS, Qos
from neuros.transport.codecs import WrongBytes, message_codec
from neuros.transport.messages import encode_packet, message_class, packet_kind
from neuros.transport.ros_loop import RosLoop

_QOS_POLL_S = 0.3
_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
_MOST_QOS_POLLS = 20
"""The graph lists an endpoint a moment after DDS reports it, or seconds later under load."""

_ADVICE = 'give both the same, with "qos" in the project'

_SILENCE_S = 5.0
"""By then, programs that are there have been found."""

_SUBSCRIPTIONS_POLL_S = 0.25


class ExternalTopics:
    """Publishers and subscriptions of the ports with an external topic."""

    def __init__(self, file: NodeFile, ros_node: RosNode, loop: RosLoop) -> None:
        self._file = file
        self._ros_node = ros_node
        self._loop = loop
        self._publishers: dict[str, Publisher] = {}
        self._is_open = False

    def open(self, inbox: Inbox) -> None:
        """Create the endpoints, and watch whether others can be connected to them."""
        self._is_open = True
        for port in self._file.node.outputs:
            if port.external_topic is not None:
                profile = qos_profile(port.qos or OFFERED)
                check = self._qos_check(port, port.external_topic, profile, is_input=False)
                self._publishers[port.name] = self._ros_node.create_publisher(
                    message_class(port.type),
                    port.external_topic,
                    profile,
                    event_callbacks=PublisherEventCallbacks(incompatible_qos=check),
                )
        subscriptions = {
            port: self._subscription(port, port.external_topic, inbox)
            for port in self._file.node.inputs
            if port.external_topic is not None and not port.external_topic.startswith(SESSION)
        }
        if subscriptions:
            self._loop.expect_arrivals()
            _check_silence(self._ros_node, subscriptions, self._loop)

    def send(self, port: Port, packet: Any) -> None:
        if self._is_open:
            self._publishers[port.name].publish(encode_packet(packet))

    def close(self) -> None:
        """Publish and receive nothing any more; the endpoints go with their ROS node."""
        self._is_open = False

    def _subscription(self, port: Port, topic: str, inbox: Inbox) -> Subscription:
        kind = message_class(port.type)
        profile = qos_profile(port.qos or ASKED)
        decode = message_codec(packet_kind(port.type)).decode
        has_warned = False

        def receive(data: bytes) -> None:
            nonlocal has_warned
            if not self._is_open:
                return
            try:
                packet = decode(data)
            except WrongBytes as error:  # anybody may publish there
                if not has_warned:
                    has_warned = True
                    text = f"{topic}: a packet is left out, and others like it: {error}"
                    self._ros_node.get_logger().warning(text)
            else:
                inbox.on_external_packet(port, packet)

        check = self._qos_check(port, topic, profile, is_input=True)
        return self._ros_node.create_subscription(
            kind,
            topic,
            self._loop.guarded(receive),
            profile,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=check),
            raw=True,
        )

    def _qos_check(self, port: Port, topic: str, own: QoSProfile, *, is_input: bool) -> QosCheck:
        full = self._file.names.resolve(topic, self._file.node.name)
        return QosCheck(self._ros_node, self._loop, port, full, own, is_input=is_input)


class RosGraphBridge:
    """External topics and data topics of one node whose connections stay within the process.

    External topics go through DDS as always. A data topic is published while it has subscriptions.

    Attributes:
        heard: the connections with subscriptions in ROS; looked up four times per second.
    """

    def __init__(self, file: NodeFile, ros_node: RosNode, loop: RosLoop) -> None:
        self._external = ExternalTopics(file, ros_node, loop)
        self._file = file
        self._ros_node = ros_node
        self._loop = loop
        self._publishers: dict[Connection, Publisher] = {}
        self.heard: frozenset[Connection] = frozenset()

    def open(self, inbox: Inbox) -> None:
        self._external.open(inbox)
        for connection in self._file.connections:
            if connection.source_node == self._file.node.name:
                self._publishers[connection] = self._ros_node.create_publisher(
                    message_class(self._file.node.output(connection.source_output).type),
                    f"{connection.topic}/data",
                    data_qos(connection),
                )
        if self._publishers:
            self._loop.every(self._ros_node, _SUBSCRIPTIONS_POLL_S, self._count_subscriptions)

    def show(self, connections: Sequence[Connection], packet: Any) -> None:
        """Publish a packet on data topics that have subscriptions."""
        for connection in connections:
            if connection in self.heard:
                self._publishers[connection].publish(encode_packet(packet))

    def send_external(self, port: Port, packet: Any) -> None:
        self._external.send(port, packet)

    def close(self) -> None:
        self.heard = frozenset()
        self._external.close()

    def _count_subscriptions(self) -> None:
        self.heard = frozenset(
            connection
            for connection, publisher in self._publishers.items()
            if publisher.get_subscription_count()
        )


def qos_profile(qos: Qos) -> QoSProfile:
    """The profile of rclpy for what a project file says."""
    for name in ("system_default", "best_available"):
        if qos == PRESETS[name]:
            preset: QoSProfile = QoSPresetProfiles.get_from_short_key(name)
            return preset
    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=qos.depth,
        reliability=QoSReliabilityPolicy.get_from_short_key(qos.reliability),
        durability=QoSDurabilityPolicy.get_from_short_key(qos.durability),
    )


def data_qos(connection: Connection, *, is_reader: bool = False) -> QoSProfile:
    """Deep enough for DDS itself to drop nothing that flow control lets through.

    A reader has one history for all writers: it keeps all, so that packets of others drop none.
    """
    if not connection.is_reliable:
        return QoSProfile(depth=connection.window, reliability=QoSReliabilityPolicy.BEST_EFFORT)
    profile = QoSProfile(depth=connection.window, reliability=QoSReliabilityPolicy.RELIABLE)
    if is_reader:
        profile.history = QoSHistoryPolicy.KEEP_ALL
    return profile


# ---------------------------------------------------------------------- ROS graph checks


class QosCheck:
    """Warns of endpoints with QoS that keeps DDS from connecting them to a port, once each.

    A subscription gets nothing from a publisher that offers less than it asks for (OMG DDS 1.4,
    2.2.3). DDS tells both ends that there is such a pair; the ROS graph knows the other's QoS.

    Args:
        topic: its full name.
        own: what the port offers (an output) or asks for (an input).
    """

    def __init__(
        self,
        ros_node: RosNode,
        loop: RosLoop,
        port: Port,
        topic: str,
        own: QoSProfile,
        *,
        is_input: bool,
    ) -> None:
        self._ros_node = ros_node
        self._loop = loop
        self._port = port
        self._topic = topic
        self._own = own
        self._is_input = is_input
        self._log = ros_node.get_logger()
        self._name = f"{'input' if is_input else 'output'} '{port.name}'"
        self._named: set[bytes] = set()

    def __call__(self, event: Any) -> None:
        """DDS has found an endpoint that does not fit: look for it in the ROS graph."""
        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        total, polls = event.total_count, 0

        def poll() -> None:
            nonlocal polls
            polls += 1
            is_last = polls == _MOST_QOS_POLLS
            topic = self._port.external_topic  # by the name that rules apply to
            if self._is_input:
                others = self._ros_node.get_publishers_info_by_topic(topic)
            else:
                others = self._ros_node.get_subscriptions_info_by_topic(topic)
            for other in others:
                ends = (other.qos_profile, self._own)
                lacking = list(qos_differences(*(ends if self._is_input else ends[::-1])))
                # The name of its node may come later than what it offers.
                if lacking and (is_last or other.node_name != _UNKNOWN_NODE):
                    self._warn(other, lacking)
            if len(self._named) >= total or is_last:
                self._ros_node.destroy_timer(timer)
                if not self._named:
                    self._log.warning(
                        f"{self._name}: another node on {self._topic} cannot be connected: its"
                        f" {policy} does not fit"
                    )

        timer = self._loop.every(self._ros_node, _QOS_POLL_S, poll)

    def _warn(self, other: TopicEndpointInfo, lacking: list[tuple[str, str]]) -> None:
        gid = bytes(other.endpoint_gid)
        if gid in self._named:
            return
        self._named.add(gid)
        name = f"{other.node_namespace.rstrip('/')}/{other.node_name}"
        offered = " and ".join(each for each, _ in lacking)
        asked = " and ".join(each for _, each in lacking)
        if self._is_input:
            text = f"{name} offers {offered}, but this input requires {asked}: it gets no packets"
        else:
            text = f"{name} requires {asked}, but this output offers {offered}: it gets no packets"
        self._log.warning(f"{self._name}: on {self._topic} {text}; {_ADVICE}")


def qos_differences(offered: QoSProfile, asked: QoSProfile) -> Iterator[tuple[str, str]]:
    """Policies, ``(offered, asked)``, by which a publisher offers less than a subscription asks.

    ``rclpy.qos.qos_check_compatible`` takes the "infinite" deadline that the graph reports for one
    that was asked for, and so refuses all that the graph lists.
    """
    reliable, best_effort = QoSReliabilityPolicy.RELIABLE, QoSReliabilityPolicy.BEST_EFFORT
    if (offered.reliability, asked.reliability) == (best_effort, reliable):
        yield "best_effort", "reliable"
    latched, volatile = QoSDurabilityPolicy.TRANSIENT_LOCAL, QoSDurabilityPolicy.VOLATILE
    if (offered.durability, asked.durability) == (volatile, latched):
        yield "volatile", "transient_local"


def is_compatible(offered: QoSProfile, asked: QoSProfile) -> bool:
    """Whether DDS connects a publisher and a subscription."""
    return not any(qos_differences(offered, asked))


class StrangerCheck:
    """Names publishers on the topics of connections that are not of their nodes, once each."""

    def __init__(self, ros_node: RosNode, loop: RosLoop) -> None:
        self._ros_node = ros_node
        self._loop = loop
        self._named: set[tuple[str, str]] = set()
        self._pending: list[Callable[[], object]] = []

    def callbacks(
        self, connection: Connection, topic: str, *writers: str
    ) -> SubscriptionEventCallbacks:
        """For the subscription to a topic on which only the nodes ``writers`` publish."""

        def on_matched(event: Any) -> None:
            if event.current_count <= len(writers):
                return
            polls = 0

            def poll(*, is_last: bool = False) -> None:
                nonlocal polls
                polls += 1
                listed = self._ros_node.get_publishers_info_by_topic(topic)
                names = Counter(each.node_name for each in listed) - Counter(writers)
                if _UNKNOWN_NODE not in names or polls == _MOST_QOS_POLLS or is_last:
                    self._ros_node.destroy_timer(timer)
                    self._pending.remove(at_end)
                    self._name(connection, topic, names)

            at_end = partial(poll, is_last=True)
            self._pending.append(at_end)
            timer = self._loop.every(self._ros_node, _QOS_POLL_S, poll)

        return SubscriptionEventCallbacks(matched=on_matched)

    def close(self) -> None:
        """Name those of whom the ROS graph does not know the node yet, too."""
        for poll in tuple(self._pending):
            poll()

    def _name(self, connection: Connection, topic: str, names: Iterable[str]) -> None:
        new = sorted({(topic, name) for name in names} - self._named)
        if new:
            self._named.update(new)
            others = " and ".join(
                "a program that is no ROS node" if name == _UNKNOWN_NODE else name
                for _, name in new
            )
            self._ros_node.get_logger().warning(
                f"{connection}: on {topic}, others publish, too: {others}. What they send there"
                " counts as sent by the node of the connection. --isolate keeps others out"
            )


def _check_silence(
    ros_node: RosNode, subscriptions: Mapping[Port, Subscription], loop: RosLoop
) -> None:
    """Warn in the node's log of external inputs without a publisher, 5 s from now.

    Those whose QoS does not fit are left to :class:`QosCheck`.

    Args:
        subscriptions: by inputs with an external topic.
    """

    def poll() -> None:
        ros_node.destroy_timer(timer)
        for port, subscription in subscriptions.items():
            if subscription.get_publisher_count():
                continue
            reason = _reason(ros_node, port, subscription)
            if reason:
                ros_node.get_logger().warning(f"input '{port.name}': {reason}")

    timer = loop.every(ros_node, _SILENCE_S, poll)


def _reason(ros_node: RosNode, port: Port, subscription: Subscription) -> str:
    topic = subscription.topic_name
    listed = ros_node.get_publishers_info_by_topic(port.external_topic)
    types = {each.topic_type for each in listed}
    if types - {port.ros_type}:
        return f"{topic} is published as {' and '.join(sorted(types))}, not as {port.ros_type}"
    if types:
        if not any(is_compatible(each.qos_profile, subscription.qos_profile) for each in listed):
            return ""
        names = " and ".join(sorted({each.node_name for each in listed}))
        return f"{names} publishes on {topic}, but DDS has not connected the two"
    return (
        f"nobody publishes on {topic}, or nobody that can be seen from here: another ROS domain, "
        "network or machine, a container with a network of its own, DDS without UDP"
    )
