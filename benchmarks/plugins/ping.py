"""Serves a packet, times how long it takes until one is back, and serves again.

ROUND_TRIPS in the environment is how many, BYTES the size of the packet. In the node's folder,
result.json gets their durations in microseconds, worked.json the processor time of the process for
each hundred of them, calls.json how many functions its thread calls in each of some further ones.
"""

import itertools
import json
import os
import sys
import time

from packets import fill

from neuros.hooks import Optional, neuros_function, neuros_initialise

COUNTED = 50


class Times:
    """Moments at which a packet came back, in nanoseconds; ``ball`` is what was served first."""

    def __init__(self, ball, wanted):
        self.ball = ball
        self.moments_ns = []
        self.worked_ns = []
        self.calls = []
        self.wanted = wanted

    def count(self, frame, event, argument):
        if event in ("call", "c_call"):
            self.calls[-1] += 1


def differences_us(moments_ns):
    return [(later - earlier) / 1e3 for earlier, later in itertools.pairwise(moments_ns)]


def write(node, name, values):
    (node.run_dir / f"{name}.json").write_text(json.dumps(values))


@neuros_initialise(outputs="ball")
def serve(node):
    ball = fill(node.make_packet("ball"), int(os.environ["BYTES"]))
    node.set_user_data(Times(ball, int(os.environ["ROUND_TRIPS"])))
    return ball


@neuros_function(inputs="back", outputs=Optional("ball"))
def strike(node, packet):
    times = node.get_user_data()
    times.moments_ns.append(time.perf_counter_ns())
    done = len(times.moments_ns)
    if done % 100 == 0:
        times.worked_ns.append(time.process_time_ns())
    if done > times.wanted:
        times.calls.append(0)
        if done == times.wanted + 1:
            write(node, "result", differences_us(times.moments_ns))
            write(node, "worked", differences_us(times.worked_ns))
            sys.setprofile(times.count)
        elif done > times.wanted + COUNTED:
            sys.setprofile(None)
            write(node, "calls", times.calls[1:-1])
            node.shutdown("all round trips are timed")
            return None
    return packet if type(packet) is type(times.ball) else times.ball
