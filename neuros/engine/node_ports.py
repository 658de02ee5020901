"""The ports of a node in its engine: subscriptions, send windows, outputs and inputs of hooks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias

from neuros.engine.connection_ends import HookInput, SendWindow, Subscription
from neuros.engine.sim_clock import ClockSubscription, SimClock, TickInput
from neuros.errors import HookError
from neuros.hooks import HookSpec
from neuros.project.model import Connection, Node, Port
from neuros.project.qos import DEPTH

Send: TypeAlias = Callable[[Any], object]
"""Sends a packet."""


class Links(Protocol):
    """The functions by which a node sends: one per output, and one per connection to the node."""

    def sender(self, port: Port, connections: Sequence[Connection]) -> Send | None:
        """The function that sends packets of an output to other nodes, or on its external topic.

        ``None`` if the output has neither.
        """

    def acknowledger(self, connection: Connection) -> Callable[[int], None]:
        """The function that acknowledges packets up to a position to the sender, another node."""


class PacketType(NamedTuple):
    """The class of the packets of an output, and their check.

    Attributes:
        check: returns a packet with the values to be sent, or raises ``WrongValue``.
    """

    kind: type
    check: Callable[[Any], Any]


class Output:
    """An output of the node, and the connections that it feeds.

    Attributes:
        packet_type: ``None`` if a hook may return any object.
        send: sends to other nodes, or on an external topic; ``None`` if there is neither.
    """

    __slots__ = ("packet_type", "port", "send", "to_itself", "windows")

    def __init__(
        self,
        port: Port,
        windows: Sequence[SendWindow],
        packet_type: PacketType | None,
        links: Links,
    ) -> None:
        self.port = port
        self.windows = tuple(windows)
        connections = [window.connection for window in windows]
        self.to_itself = tuple(c for c in connections if c.destination_node == c.source_node)
        self.packet_type = packet_type
        elsewhere = tuple(c for c in connections if c.destination_node != c.source_node)
        self.send = links.sender(port, elsewhere)


class NodePorts:
    """The ports of one node, joined to its connections.

    Args:
        connections: all that begin or end at the node, in the project's order.
        packet_types: by output name; for other outputs hooks may return any object.

    Attributes:
        subscriptions: by connection; those of external topics come last, by the name of the input.
        send_windows: by connection; a connection to the node itself is registered from the start.
        outputs: by name.
        sim_clock: simulated time, from the node's clock.
    """

    def __init__(
        self,
        node: Node,
        connections: Sequence[Connection],
        packet_types: Mapping[str, PacketType],
        links: Links,
        clock: Callable[[], int],
    ) -> None:
        self._node = node
        self._clock = clock
        self.sim_clock = SimClock()
        self.subscriptions: dict[Connection | str, Subscription] = {
            c: self._subscription(
                c,
                str(c),
                c.destination_input,
                c.queue_size,
                is_lossless=c.discard_limit == 0,
                is_acknowledged=c.is_reliable,
            )
            for c in connections
            if c.destination_node == node.name
        }
        for c in connections:
            if c.destination_node == node.name != c.source_node and c.is_reliable:
                self.subscriptions[c].acknowledge = links.acknowledger(c)
        for port in node.inputs:
            if port.external_topic is not None:
                depth = DEPTH if port.qos is None else port.qos.depth or DEPTH
                self.subscriptions[port.name] = self._subscription(
                    port.name, port.external_topic, port.name, depth
                )
        self.send_windows = {c: SendWindow(c) for c in connections if c.source_node == node.name}
        for connection, window in self.send_windows.items():
            window.is_registered = connection.destination_node == node.name
        self.outputs = {
            port.name: Output(
                port,
                [o for c, o in self.send_windows.items() if c.source_output == port.name],
                packet_types.get(port.name),
                links,
            )
            for port in node.outputs
        }

    def inputs_of(self, spec: HookSpec) -> list[HookInput]:
        """The inputs of a hook, after a check of its ports.

        Raises:
            HookError: if the node has no such port, or nothing feeds a required input.
        """
        inputs = [port.name for port in self._node.inputs]
        for kind, ports, known in (
            ("input", spec.inputs, inputs),
            ("output", spec.outputs, [*self.outputs]),
        ):
            for port in ports:
                if port.name not in known:
                    text = "{} ({})".format(*self._node.undeclared(kind, port.name))
                    raise HookError(text, hook=spec.name, where=spec.where)
        found: list[HookInput] = []
        for port in spec.inputs:
            feeding = [s for s in self.subscriptions.values() if s.input_name == port.name]
            if not feeding and not port.is_optional:
                text = ": ".join(self._node.unfed(port.name))
                raise HookError(text, hook=spec.name, where=spec.where)
            if spec.sim_period_s is not None and self._is_clock(port.name):
                period_s = spec.sim_period_s
                found.append(TickInput(port, feeding, period_s, self._clock, self.sim_clock))
            else:
                found.append(HookInput(port, feeding))
        return found

    def _subscription(
        self, key: Connection | str, name: str, input_name: str, capacity: int, **kind: bool
    ) -> Subscription:
        if not self._is_clock(input_name):
            return Subscription(key, name, input_name, capacity, **kind)
        subscription = ClockSubscription(key, name, input_name, capacity, **kind)
        subscription.sim_clock = self.sim_clock
        return subscription

    def _is_clock(self, input_name: str) -> bool:
        return self._node.clock is not None and self._node.clock.name == input_name
