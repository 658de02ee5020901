"""A node of a ring: checks a packet, and sends one of its own. The first one starts and ends it."""

import json

from traffic import COUNT, Receiver, Sender

from neuros.hooks import Optional, neuros_finalise, neuros_function, neuros_initialise

sender, receiver = Sender(), Receiver()


@neuros_initialise(outputs=Optional("o"))
def begin(node):
    return sender.fill(node, node.make_packet("o")) if node.name == "n0" else None


@neuros_function(inputs="x", outputs=Optional("o"))
def relay(node, image):
    receiver.take(image)
    if node.name == "n0" and sender.count == COUNT:
        node.shutdown("all sent")
        return None
    return sender.fill(node, node.make_packet("o"))


@neuros_finalise()
def note(node):
    (node.run_dir / "told.json").write_text(json.dumps({**receiver.told(), "sent": sender.told()}))
