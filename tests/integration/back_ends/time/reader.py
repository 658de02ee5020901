"""Reads the clock."""

from neuros.hooks import neuros_function


@neuros_function(inputs="clock")
def read(node, clock):
    pass
