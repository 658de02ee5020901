"""Serves a packet, times how long it takes until one is back, and serves again.

ROUND_TRIPS in the environment is how many, BYTES the size of the packet; result.json in the node's
folder gets their durations in microseconds.
"""

import itertools
import json
import os
import time

from packets import fill

from neuros.hooks import Optional, neuros_function, neuros_initialise


class Times:
    """Moments at which a packet came back, in nanoseconds; ``ball`` is what was served first."""

    def __init__(self, ball, wanted):
        self.ball = ball
        self.moments_ns = []
        self.wanted = wanted

    def durations_us(self):
        pairs = itertools.pairwise(self.moments_ns)
        return [(later - earlier) / 1e3 for earlier, later in pairs]


@neuros_initialise(outputs="ball")
def serve(node):
    ball = fill(node.make_packet("ball"), int(os.environ["BYTES"]))
    node.set_user_data(Times(ball, int(os.environ["ROUND_TRIPS"])))
    return ball


@neuros_function(inputs="back", outputs=Optional("ball"))
def strike(node, packet):
    times = node.get_user_data()
    times.moments_ns.append(time.perf_counter_ns())
    if len(times.moments_ns) <= times.wanted:
        return packet if type(packet) is type(times.ball) else times.ball
    (node.run_dir / "result.json").write_text(json.dumps(times.durations_us()))
    node.shutdown("all round trips are timed")
    return None
