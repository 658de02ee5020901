"""Takes all that the simulator sends."""

from neuros.hooks import neuros_function


@neuros_function(inputs="state")
def work(node, state):
    pass
