"""From a node's declaration to what its engine works on: inlets, outlets, outputs and hooks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from neuros.core.flow import Outlet
from neuros.core.hook import Hook, Output, PacketType
from neuros.core.inputs import Inlet, InputSlot
from neuros.errors import HookError
from neuros.hooks import HookSpec, InputSpec
from neuros.project.model import Connection, Node
from neuros.project.qos import DEPTH


class NodePorts:
    """Both sides of a node.

    Args:
        connections: all that begin or end at the node, in the project's order.
        packet_types: per output name; hooks may return anything where there is none.

    Attributes:
        inlets: by connection, and by the name of the input for external topics, which come last.
        outlets: by connection; one to the node itself is registered from the start.
        outputs: by name.
    """

    def __init__(
        self,
        node: Node,
        connections: Sequence[Connection],
        packet_types: Mapping[str, PacketType],
    ) -> None:
        self._node = node
        self.inlets: dict[Connection | str, Inlet] = {
            c: _inlet(c) for c in connections if c.destination_node == node.name
        }
        for port in node.inputs:
            if port.external_topic is not None:
                depth = DEPTH if port.qos is None else port.qos.depth or DEPTH
                self.inlets[port.name] = Inlet(port.name, port.external_topic, port.name, depth)
        self.outlets = {c: Outlet(c) for c in connections if c.source_node == node.name}
        for connection, outlet in self.outlets.items():
            outlet.is_registered = connection.destination_node == node.name
        self.outputs = {
            port.name: Output(
                port,
                [o for c, o in self.outlets.items() if c.source_output == port.name],
                packet_types.get(port.name),
            )
            for port in node.outputs
        }

    def hook(self, spec: HookSpec) -> Hook:
        """A hook, joined to the ports that it names.

        Raises:
            HookError: if the node has no such port, or a required input has no source.
        """
        inputs = [port.name for port in self._node.inputs]
        for side, ports, known in (
            ("input", spec.inputs, inputs),
            ("output", spec.outputs, [*self.outputs]),
        ):
            for port in ports:
                if port.name not in known:
                    text = undeclared(side, port.name, known, self._node)
                    raise HookError(text, hook=spec.name, where=spec.where)
        return Hook(spec, [self._slot(spec, port) for port in spec.inputs], self.outputs)

    def _slot(self, spec: HookSpec, port: InputSpec) -> InputSlot:
        inlets = [inlet for inlet in self.inlets.values() if inlet.input_name == port.name]
        if not inlets and not port.is_optional:
            raise HookError(
                f"needs input '{port.name}', but nothing is connected to"
                f" {self._node.name}.{port.name}: connect it, or declare it Optional",
                hook=spec.name,
                where=spec.where,
            )
        return InputSlot(port, inlets)


def undeclared(side: str, name: str, known: Iterable[str], node: Node) -> str:
    """What is wrong with a port that a node has not."""
    has = ", ".join(sorted(known)) or "none"
    return f"node '{node.name}' declares no {side} '{name}' (it has {has})"


def _inlet(connection: Connection) -> Inlet:
    return Inlet(
        connection,
        str(connection),
        connection.destination_input,
        connection.queue_size,
        is_lossless=connection.discard_limit == 0,
        is_acknowledged=connection.is_reliable,
    )
