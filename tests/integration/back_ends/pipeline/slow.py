"""Works for 3 ms on each number."""

import time

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise


@neuros_initialise()
def begin(node):
    node.set_user_data([])


@neuros_function(inputs="number")
def take(node, number):
    node.get_user_data().append(number.data)
    time.sleep(0.003)


@neuros_finalise()
def end(node):
    (node.run_dir / "taken").write_text(" ".join(map(str, node.get_user_data())))
