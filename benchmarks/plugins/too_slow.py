"""Takes FAST_TAKES_S and OTHER_TAKES_S for a packet; result.json gets what Waits says of them."""

import json
import os

from waits import Waits

from neuros.hooks import neuros_function, neuros_initialise


@neuros_initialise()
def start(node):
    takes_s = {name: float(os.environ[f"{name.upper()}_TAKES_S"]) for name in ("fast", "other")}
    node.set_user_data(Waits(takes_s, float(os.environ["SECONDS"])))


@neuros_function(inputs="fast")
def fast(node, packet):
    take(node, "fast", packet)


@neuros_function(inputs="other")
def other(node, packet):
    take(node, "other", packet)


def take(node, name, packet):
    waits = node.get_user_data()
    if waits.take(name, packet.data):
        (node.run_dir / "result.json").write_text(json.dumps(waits.result()))
        node.shutdown("enough was taken")
