"""Two inputs that are both too fast."""

from notes import take

from neuros.hooks import neuros_function


@neuros_function(inputs="left")
def left(node, packet):
    take(node, "left", packet, 0.15)


@neuros_function(inputs="right")
def right(node, packet):
    take(node, "right", packet, 0.15)
