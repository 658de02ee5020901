"""Takes six times as long as there is between two packets."""

from notes import take

from neuros.hooks import neuros_function


@neuros_function(inputs="limited")
def work(node, packet):
    take(node, "work", packet, 0.3)
