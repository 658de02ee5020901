"""Sends COUNT numbers as fast as its receivers allow, and then ends the project."""

import os

from neuros.hooks import neuros_function, neuros_initialise

COUNT = int(os.environ["COUNT"])


@neuros_initialise()
def begin(node):
    node.set_user_data(0)


@neuros_function(outputs=["number", "series"])
def emit(node):
    count = node.get_user_data() + 1
    node.set_user_data(count)
    number, series = node.make_packet("number"), node.make_packet("series")
    number.data = count
    series.data = [count / 3] * 4  # a third is rounded in the float32 of the message
    if count == COUNT:
        node.shutdown("all sent")
    return number, series
