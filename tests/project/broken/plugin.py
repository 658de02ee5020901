"""The plugin of the broken projects; it is never loaded."""

from neuros.hooks import neuros_function


@neuros_function()
def step(node):
    """Nothing is wrong with it."""
