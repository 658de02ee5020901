"""Counts what arrives for SECONDS from the environment; result.json gets packets per second."""

import json
import os
import time

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise

WARM_UP = 200


@neuros_initialise()
def start(node):
    length_ns = float(os.environ["SECONDS"]) * 1e9
    node.set_user_data({"packets": -WARM_UP, "start_ns": 0, "now_ns": 0, "length_ns": length_ns})


@neuros_function(inputs="ball")
def count(node, packet):
    data = node.get_user_data()
    data["packets"] += 1
    data["now_ns"] = time.perf_counter_ns()
    if data["packets"] <= 0:
        data["start_ns"] = data["now_ns"]
    elif data["now_ns"] - data["start_ns"] >= data["length_ns"]:
        node.shutdown("enough packets are counted")


@neuros_finalise()
def write(node):
    data = node.get_user_data()
    rate = max(0, data["packets"]) / max(1, data["now_ns"] - data["start_ns"]) * 1e9
    (node.run_dir / "result.json").write_text(json.dumps(rate))
