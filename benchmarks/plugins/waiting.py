"""Waits for packets that nobody sends, and ticks every TICK_S seconds."""

import os

from neuros.hooks import neuros_function, neuros_initialise, neuros_tick


@neuros_initialise()
def start(node):
    (node.run_dir / "started").write_text("yes")


@neuros_function(inputs="in_", outputs="out")
def relay(node, packet):
    return packet


@neuros_tick(seconds=float(os.environ["TICK_S"]))
def tick(node): ...
