"""Takes what the ring sends."""

from neuros.hooks import neuros_function


@neuros_function(inputs="spikes")
def see(node, spikes):
    pass


@neuros_function(inputs="rates")
def look(node, rates):
    pass
