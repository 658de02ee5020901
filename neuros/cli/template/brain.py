"""The brain: answers each heading with a rate of turning."""

import os

from neuros.hooks import neuros_function

GAIN_PER_S = float(os.environ.get("GAIN", "2"))


@neuros_function(inputs="heading", outputs="turn")
def steer(node, heading):
    packet = node.make_packet("turn")
    packet.data = -GAIN_PER_S * heading.data
    return packet
