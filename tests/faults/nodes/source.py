"""Sends whole numbers, one each 20 ms."""

import itertools

from neuros.hooks import neuros_tick

_numbers = itertools.count(1)


@neuros_tick(seconds=0.02, outputs="number")
def count(node):
    packet = node.make_packet("number")
    packet.data = next(_numbers)
    return packet
