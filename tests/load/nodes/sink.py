"""Checks what it receives."""

import json

from traffic import Receiver

from neuros.hooks import neuros_finalise, neuros_function

receiver = Receiver()


@neuros_function(inputs="x")
def take(node, image):
    receiver.take(image)


@neuros_finalise()
def note(node):
    (node.run_dir / "told.json").write_text(json.dumps(receiver.told()))
