"""Sends COUNT images of SIZE bytes, one per PERIOD seconds; 0: it goes on for ever."""

import os
import time
from array import array

from neuros.hooks import neuros_tick

COUNT = int(os.environ["COUNT"])
PIXELS = array("B", bytes(int(os.environ["SIZE"])))
BREAKS_AT = int(os.environ.get("BREAKS_AT", "0"))
sent = 0


@neuros_tick(seconds=float(os.environ["PERIOD"]), outputs="image")
def send(node):
    global sent
    sent += 1
    if sent == BREAKS_AT:
        raise ValueError("broken")
    if sent == COUNT:
        node.shutdown("all sent", drain_s=float(os.environ.get("DRAIN_S", "5")))
    image = node.make_packet("image")
    image.header.stamp.sec, image.header.stamp.nanosec = divmod(time.monotonic_ns(), 10**9)
    image.header.frame_id = str(sent)
    image.data = PIXELS
    return image
