"""Sends PACED packets, one every 10 ms; then as many as its output lets it, one after the other.

The second part runs on a connection of the node to itself, so that it does not begin before.
"""

import os

from arrivals import flood, paced

from neuros.hooks import Optional, neuros_function, neuros_initialise, neuros_tick


class Sent:
    """How many packets of either kind have been sent."""

    def __init__(self):
        self.paced = 0
        self.flood = 0


@neuros_initialise()
def start(node):
    node.set_user_data(Sent())


@neuros_tick(seconds=0.01, outputs=[Optional("out"), Optional("again")])
def pace(node):
    sent, wanted = node.get_user_data(), int(os.environ["PACED"])
    sent.paced += 1
    if sent.paced > wanted:
        return None, node.make_packet("again") if sent.paced == wanted + 1 else None
    packet = node.make_packet("out")
    packet.data = paced()
    return packet, None


@neuros_function(inputs="again", outputs=["out", "again"])
def send(node, again):
    sent = node.get_user_data()
    sent.flood += 1
    packet = node.make_packet("out")
    packet.data = flood(node.name, sent.flood)
    return packet, again
