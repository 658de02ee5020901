"""Sends back what arrives."""

from neuros.hooks import neuros_function


@neuros_function(inputs="ball", outputs="back")
def echo(node, packet):
    return packet
