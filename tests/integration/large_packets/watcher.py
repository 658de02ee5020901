"""Writes down the number of each image, and whether its pixels are those that were sent.

Every other image is looked at only when the next one is there.
"""

import os
import time

from pixels import pixels

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise


@neuros_initialise()
def begin(node):
    node.set_user_data([])


def judge(node, image):
    number = image.header.stamp.sec
    with open(node.run_dir / "seen", "a") as file:
        file.write(f"{number} {image.data.tobytes() == pixels(number)}\n")


@neuros_function(inputs="image")
def see(node, image):
    kept = node.get_user_data()
    kept.append(image)
    if len(kept) == 2:
        for each in kept:
            judge(node, each)
        kept.clear()
    time.sleep(float(os.environ["PAUSE_S"]))


@neuros_finalise()
def end(node):
    for image in node.get_user_data():
        judge(node, image)
