"""Serves a packet, times how long it takes until it is back, and serves it again.

ROUND_TRIPS in the environment is how many; result.json in the node's folder gets their durations.
"""

import itertools
import json
import os
import time

from neuros.hooks import Optional, neuros_function, neuros_initialise


class Times:
    """Moments at which the packet came back, in nanoseconds."""

    def __init__(self, wanted):
        self.moments_ns = []
        self.wanted = wanted

    def durations_us(self):
        pairs = itertools.pairwise(self.moments_ns)
        return [(later - earlier) / 1e3 for earlier, later in pairs]


@neuros_initialise(outputs="ball")
def serve(node):
    node.set_user_data(Times(int(os.environ["ROUND_TRIPS"])))
    return node.make_packet("ball")


@neuros_function(inputs="back", outputs=Optional("ball"))
def strike(node, packet):
    times = node.get_user_data()
    times.moments_ns.append(time.perf_counter_ns())
    if len(times.moments_ns) <= times.wanted:
        return packet
    (node.run_dir / "result.json").write_text(json.dumps(times.durations_us()))
    node.shutdown("all round trips are timed")
    return None
