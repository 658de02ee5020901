"""Writes down what arrives, and ends when all has."""

from neuros.hooks import neuros_function

INPUTS = ("twist", "flag", "colour", "poses", "count", "odometry", "levels")


@neuros_function(inputs=[*INPUTS, "said"])
def write(node, *packets):
    for name, packet in zip((*INPUTS, "said"), packets, strict=True):
        (node.run_dir / name).write_text(repr(packet))
    node.shutdown("all has arrived")
