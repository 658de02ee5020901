"""Sends the next number when the double of the last one is back."""

import os
from random import Random

from neuros.hooks import Optional, neuros_finalise, neuros_function, neuros_initialise, neuros_tick

LAST = int(os.environ["LAST"])
drawn = Random(int(os.environ["SEED"]))


@neuros_initialise(outputs="number")
def begin(node):
    node.set_user_data([])
    return number(node, 1)


@neuros_tick(seconds=3600.0)
def hour(node):
    pass


@neuros_function(inputs="double", outputs=Optional("number"))
def count(node, double):
    doubles = node.get_user_data()
    doubles.append(double.data)
    if len(doubles) == LAST:
        node.set_result("doubles", doubles)
        node.shutdown("all counted")
        return None
    return number(node, len(doubles) + 1)


@neuros_finalise()
def note(node):
    (node.run_dir / "drawn.txt").write_text(f"{drawn.random()}\n")


def number(node, value):
    packet = node.make_packet("number")
    packet.data = value
    return packet
