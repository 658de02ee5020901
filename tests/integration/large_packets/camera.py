"""Sends COUNT images, each of pixels that follow from its number; says where they are stored."""

import os
from array import array
from pathlib import Path

from pixels import pixels

from neuros.hooks import Optional, neuros_function, neuros_initialise


@neuros_initialise()
def begin(node):
    node.set_user_data(0)


@neuros_function(outputs=Optional("image"))
def take(node):
    number = node.get_user_data() + 1
    node.set_user_data(number)
    if number == 3:
        stored = Path("/dev/shm").glob(f"neuros_{os.environ['NEUROS_RUN_ID']}_camera_image_*")
        text = " ".join(path.name for path in stored)
        node.get_logger().info(f"process {os.getpid()} stores in {text}")
    if number > int(os.environ["COUNT"]):
        node.shutdown("all images are taken")
        return None
    image = node.make_packet("image")
    image.height, image.width, image.step, image.encoding = 480, 640, 1920, "bgr8"
    image.header.stamp.sec = number
    image.data = array("B", pixels(number))
    return image
