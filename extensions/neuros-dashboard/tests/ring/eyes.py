"""Takes the rates of the ring."""

from neuros.hooks import neuros_function


@neuros_function(inputs="rates")
def look(node, rates):
    pass
