"""What passes between hooks and neighbours: packets in, acknowledgements out, packets out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from neuros.core.effects import Effects
from neuros.core.hook import Hook, Output
from neuros.core.inputs import Inlet
from neuros.core.node_ports import NodePorts
from neuros.project.model import Connection, Node


class Exchange:
    """The traffic of one node.

    Args:
        deliver: called, as an event, with a packet of the node for itself.

    Attributes:
        to_itself: how many packets of the node for itself are on their way.
    """

    def __init__(
        self,
        node: Node,
        ports: NodePorts,
        effects: Effects,
        clock: Callable[[], int],
        deliver: Callable[[Connection, Any], None],
    ) -> None:
        self._node = node
        self._inlets, self._outlets = ports.inlets, ports.outlets
        self._effects = effects
        self._clock = clock
        self._deliver = deliver
        self._arrivals = 0
        self.to_itself = 0

    def receive(self, key: Connection | str, packet: Any) -> None:
        """A packet has arrived on a connection, or on the external topic of the input ``key``."""
        inlet = self._inlets[key]
        self._arrivals += 1
        inlet.put(self._arrivals, packet)
        if not inlet.mailboxes:
            self._acknowledge(inlet)

    def take(self, hook: Hook, now_ns: int) -> list[Any]:
        """The arguments of a hook that starts now; their senders are told."""
        touched: list[Inlet] = []
        arguments = [slot.take(touched) for slot in hook.slots]
        for inlet in touched:
            inlet.taken_ns.append(now_ns)
            self._acknowledge(inlet)
        return arguments

    def retire(self, hook: Hook) -> None:
        """Count no longer on a hook that took inputs and will never run again."""
        for slot in hook.slots:
            for mailbox in slot.mailboxes:
                mailbox.inlet.remove(mailbox)
                self._acknowledge(mailbox.inlet)

    def send(self, output: Output, packet: Any, now_ns: int) -> None:
        """Send a packet now on all connections of an output, or on its external topic."""
        if output.port.external_topic is not None:
            self._effects.send_external(output.port, packet)
            return
        for outlet in output.outlets:
            outlet.spend(now_ns)
        for connection in output.to_itself:
            self._send_to_itself(connection, packet)
        if output.elsewhere:
            self._effects.send(output.elsewhere, packet)

    def _send_to_itself(self, connection: Connection, packet: Any) -> None:
        own = self._effects.copy_to_itself(connection, packet)
        self.to_itself += 1

        def arrive() -> None:
            self.to_itself -= 1
            self._deliver(connection, own)

        self._effects.post(arrive)

    def _acknowledge(self, inlet: Inlet) -> None:
        if not inlet.is_acknowledged:
            return
        position = inlet.position_if_taken()
        if position <= inlet.acknowledged:
            return
        inlet.acknowledged = position
        connection: Any = inlet.key  # external topics are not acknowledged
        if connection.source_node == self._node.name:
            self._outlets[connection].credit(position, self._clock())
        else:
            self._effects.acknowledge(connection, position)
