"""Reads the clock, and leaves a file where it has."""

from neuros.hooks import neuros_function


@neuros_function(inputs="clock")
def read(node, clock):
    (node.run_dir / "seen").touch()
