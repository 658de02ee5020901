"""Answers whatever arrives with a small packet."""

from packets import fill

from neuros.hooks import neuros_function, neuros_initialise


@neuros_initialise()
def start(node):
    node.set_user_data(fill(node.make_packet("back"), 8))


@neuros_function(inputs="ball", outputs="back")
def answer(node, packet):
    return node.get_user_data()
