"""A main loop that does nothing: what is left is what NeuROS itself needs per execution.

EXECUTIONS in the environment is how many; result.json in the node's folder gets the time in
microseconds from one to the next, on average.
"""

import json
import os
import time

from neuros.hooks import neuros_function, neuros_initialise

WARM_UP = 1000


@neuros_initialise()
def start(node):
    node.set_user_data({"executions": -WARM_UP, "wanted": int(os.environ["EXECUTIONS"])})


@neuros_function()
def idle(node):
    data = node.get_user_data()
    data["executions"] += 1
    if data["executions"] == 0:
        data["start_ns"] = time.perf_counter_ns()
    elif data["executions"] == data["wanted"]:
        each_us = (time.perf_counter_ns() - data["start_ns"]) / data["wanted"] / 1e3
        (node.run_dir / "result.json").write_text(json.dumps(each_us))
        node.shutdown("all executions are timed")
