"""The plugin of nodes with ``"network"``: one packet of each input is one step of the network."""

from __future__ import annotations

import os
from array import array
from pathlib import Path
from typing import Any

import numpy as np

from neuros.errors import NodeError
from neuros.hooks import neuros_function, neuros_initialise
from neuros_learn.nir.network import Network, discretisation_of
from neuros_learn.nir.network_file import read_graph

_GRAPH = read_graph(Path(os.environ["NETWORK"]))
_INPUTS, _OUTPUTS = _GRAPH.names("Input"), _GRAPH.names("Output")


@neuros_initialise()
def build(node: Any) -> None:
    node.set_user_data(Network(_GRAPH, discretisation_of(node.description.parameters)))


@neuros_function(inputs=_INPUTS, outputs=_OUTPUTS)
def step(node: Any, *packets: Any) -> list[Any]:
    network, values = node.get_user_data(), {}
    for name, packet in zip(_INPUTS, packets, strict=True):
        numbers = packet if isinstance(packet, np.ndarray) else packet.data
        given, shape = np.asarray(numbers, np.float32), network.inputs[name]
        if given.size != np.prod(shape):
            text = f"input '{name}' has {given.size} values, and the network takes {shape}"
            raise NodeError(text)
        values[name] = given.reshape(shape)
    found = network.step(values)
    made = []
    for name in _OUTPUTS:
        packet, out = node.make_packet(name), found[name]
        if isinstance(packet, np.ndarray):
            if packet.size != out.size:
                text = f"output '{name}' carries {packet.size} values"
                raise NodeError(f"{text}, and the network gives {out.shape}")
            packet.flat[:] = out.flat
        elif isinstance(packet.data, array):
            code = packet.data.typecode
            packet.data = array(code, out.astype(code).tobytes())
        elif out.size == 1:
            packet.data = out.item()
        else:
            raise NodeError(f"output '{name}' carries one value, and the network gives {out.shape}")
        made.append(packet)
    return made
