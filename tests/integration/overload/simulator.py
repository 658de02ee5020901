"""A main loop: each acknowledgement that it gets could start it once more."""

from notes import send, take

from neuros.hooks import Optional, neuros_function


@neuros_function(inputs=Optional("command"), outputs="state")
def step(node, command):
    take(node, "step", command, 0.005)
    return send(node, "state")
