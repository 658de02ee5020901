"""Which connections of a node carry large packets through shared memory, and by what.

A receiver says with its registration what it sees of shared memory (:func:`machine_token`); to one
that sees the same, the output sends parcels. All receivers of an output share its segment.
"""

from __future__ import annotations

import os
from collections.abc import Callable

from neuros.project.model import Connection, NodeFile
from neuros.transport.codecs import Decoder, Encoder, message_codec
from neuros.transport.large_packets import LargeInput, LargeOutput, machine_token, slots_for
from neuros.transport.message_buffers import message_buffers
from neuros.transport.messages import message_class


class LargeCodecs:
    """The codecs of one node's large packets.

    Attributes:
        inputs: what receives on each connection whose packets can be large.
    """

    def __init__(self, file: NodeFile, warn: Callable[[str], object]) -> None:
        self._node = file.node
        self._connections = file.connections
        self._warn = warn
        self._outputs: dict[str, LargeOutput] = {}
        self.inputs: dict[Connection, LargeInput] = {}

    def decoder(self, connection: Connection) -> Decoder:
        """What receives on a connection to this node."""
        kind = message_class(self._node.input(connection.destination_input).type)
        buffers = message_buffers(kind)
        if buffers is None:
            return message_codec(kind)
        decoder = LargeInput(kind, buffers, is_reliable=connection.is_reliable)
        self.inputs[connection] = decoder
        return decoder

    def note(self, connection: Connection) -> str:
        """What the receiver of a connection lets its sender know; empty: no parcels."""
        return machine_token() if connection in self.inputs else ""

    def encoder(
        self, connection: Connection, note: str, count_readers: Callable[[], int]
    ) -> Encoder | None:
        """What sends to a receiver that has let us know ``note``; ``None``: the plain way."""
        if not note or note != machine_token():
            return None
        kind = message_class(self._node.output(connection.source_output).type)
        buffers = message_buffers(kind)
        if buffers is None:
            return None
        name = connection.source_output
        if name not in self._outputs:
            run = os.environ.get("NEUROS_RUN_ID") or f"pid{os.getpid()}"
            self._outputs[name] = LargeOutput(
                kind,
                buffers,
                owner=f"{run}_{self._node.name}_{name}",
                slots=slots_for([each for each in self._connections if each.source_output == name]),
                warn=self._warn,
            )
        self._outputs[name].add_receiver(count_readers)
        return self._outputs[name]

    def settle(self, connection: Connection, position: int) -> None:
        """A receiver is about to acknowledge a position."""
        decoder = self.inputs.get(connection)
        if decoder is not None:
            decoder.settle(position)

    def close(self) -> None:
        """Remove what this node has in shared memory, and give up what it has mapped."""
        for output in self._outputs.values():
            output.close()
        for decoder in self.inputs.values():
            decoder.close()
