"""Counts what arrives for SECONDS; result.json in the node's folder gets what it has seen."""

import json
import os

from arrivals import Arrivals

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise


@neuros_initialise()
def start(node):
    node.set_user_data(Arrivals(float(os.environ["SECONDS"])))


@neuros_function(inputs="ball")
def count(node, packet):
    if node.get_user_data().take(packet.data):
        node.shutdown("all is counted")


@neuros_finalise()
def write(node):
    result = node.get_user_data().result()
    (node.run_dir / "result.json").write_text(json.dumps(result))
