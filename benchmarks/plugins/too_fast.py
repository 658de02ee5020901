"""Sends the time, in nanoseconds, on two outputs, every FAST_S and every OTHER_S seconds."""

import os
import time

from neuros.hooks import neuros_tick


@neuros_tick(seconds=float(os.environ["FAST_S"]), outputs="fast")
def fast(node):
    return now(node, "fast")


@neuros_tick(seconds=float(os.environ["OTHER_S"]), outputs="other")
def other(node):
    return now(node, "other")


def now(node, output):
    packet = node.make_packet(output)
    packet.data = time.monotonic_ns()
    return packet
