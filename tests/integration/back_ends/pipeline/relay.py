"""Passes on every number, and the sum of all so far."""

from neuros.hooks import neuros_function, neuros_initialise


@neuros_initialise()
def begin(node):
    node.set_user_data(0)


@neuros_function(inputs=["number", "series"], outputs=["number", "total"])
def relay(node, number, series):
    node.set_user_data(node.get_user_data() + sum(series.data))
    total = node.make_packet("total")
    total.data = node.get_user_data()
    return number, total
