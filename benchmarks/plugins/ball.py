"""Lets one packet go round, LAPS times after WARM_UP; result.json gets microseconds per lap."""

import json
import os
import time

from neuros.hooks import Optional, neuros_function, neuros_initialise


class Laps:
    """How often the packet has come back, and when counting began."""

    def __init__(self, warm_up, wanted):
        self.count = -warm_up
        self.wanted = wanted
        self.start_ns = 0

    def have_all_come(self):
        """Count one more; returns whether it was the last."""
        self.count += 1
        if self.count == 0:
            self.start_ns = time.perf_counter_ns()
        return self.count == self.wanted

    def mean_us(self):
        return (time.perf_counter_ns() - self.start_ns) / self.wanted / 1e3


@neuros_initialise(outputs="ball")
def serve(node):
    node.set_user_data(Laps(int(os.environ["WARM_UP"]), int(os.environ["LAPS"])))
    return node.make_packet("ball")


@neuros_function(inputs="back", outputs=Optional("ball"))
def strike(node, packet):
    laps = node.get_user_data()
    if not laps.have_all_come():
        return packet
    (node.run_dir / "result.json").write_text(json.dumps(laps.mean_us()))
    node.shutdown("all laps are timed")
    return None
