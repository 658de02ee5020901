"""Takes whole numbers."""

from neuros.hooks import neuros_function


@neuros_function(inputs="number")
def take(node, number):
    pass
