"""Sends as fast as its receiver allows; BYTES in the environment is the size of a packet."""

import os

from packets import fill

from neuros.hooks import neuros_function, neuros_initialise


@neuros_initialise()
def start(node):
    node.set_user_data(fill(node.make_packet("ball"), int(os.environ["BYTES"])))


@neuros_function(outputs="ball")
def flood(node):
    return node.get_user_data()
