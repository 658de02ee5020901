"""Tells the time, once per second."""

from datetime import datetime

from neuros.hooks import neuros_tick


@neuros_tick(seconds=1.0, outputs="time")
def tick(node):
    packet = node.make_packet("time")
    packet.data = datetime.fromtimestamp(node.now().sec).strftime("%H:%M:%S")
    return packet
