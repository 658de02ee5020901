"""Notes the moments of COUNT ticks, PERIOD_S apart; result.json gets them, in nanoseconds."""

import json
import os
import time

from neuros.hooks import neuros_initialise, neuros_tick


@neuros_initialise()
def start(node):
    node.set_user_data([])


@neuros_tick(seconds=float(os.environ["PERIOD_S"]))
def tick(node):
    moments_ns = node.get_user_data()
    moments_ns.append(time.monotonic_ns())
    if len(moments_ns) == int(os.environ["COUNT"]):
        (node.run_dir / "result.json").write_text(json.dumps(moments_ns))
        node.shutdown("all ticks are noted")
