"""Sends as fast as its receivers take; where SHUTDOWN is 1, it ends the run after COUNT packets."""

import json
import os

from traffic import COUNT, Sender

from neuros.hooks import neuros_finalise, neuros_function

SHUTDOWN = os.environ.get("SHUTDOWN") == "1"
sender = Sender()


@neuros_function(outputs="o")
def send(node):
    image = sender.fill(node, node.make_packet("o"))
    if SHUTDOWN and sender.count == COUNT:
        node.shutdown("all sent")
    return image


@neuros_finalise()
def note(node):
    (node.run_dir / "told.json").write_text(json.dumps({"sent": sender.told()}))
