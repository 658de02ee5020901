"""Answers a number with its double."""

from neuros.hooks import neuros_function


@neuros_function(inputs="number", outputs="double")
def double(node, number):
    packet = node.make_packet("double")
    packet.data = 2 * number.data
    return packet
