"""Notes when its first hook starts: first_hook.txt gets the moment, monotonic, in nanoseconds."""

import time

from neuros.hooks import neuros_function, neuros_initialise


@neuros_initialise()
def start(node):
    (node.run_dir / "first_hook.txt").write_text(str(time.monotonic_ns()))


@neuros_function(inputs="in_")
def take(node, packet): ...
