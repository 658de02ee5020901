"""Takes a packet of each source at a time; ends the run after COUNT of each."""

import json

from traffic import COUNT, Receiver

from neuros.hooks import All, neuros_finalise, neuros_function

receiver = Receiver()
rounds = 0


@neuros_function(inputs=All("x"))
def take(node, images):
    global rounds
    for image in images:
        receiver.take(image)
    rounds += 1
    if rounds == COUNT:
        node.shutdown("all taken")


@neuros_finalise()
def note(node):
    (node.run_dir / "told.json").write_text(json.dumps(receiver.told()))
