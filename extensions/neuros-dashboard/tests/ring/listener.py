"""Takes the spikes of the ring."""

from neuros.hooks import neuros_function


@neuros_function(inputs="spikes")
def listen(node, spikes):
    pass
