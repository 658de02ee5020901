"""Sends images, each of one value, until the sums of all have come back."""

from array import array

from neuros.hooks import Optional, neuros_function, neuros_initialise

WIDTH, HEIGHT, IMAGES = 640, 480, 20


def image(node, value):
    message = node.make_packet("image")
    message.width, message.height, message.step = WIDTH, HEIGHT, 3 * WIDTH
    message.encoding = "rgb8"
    message.data = array("B", bytes([value])) * (3 * WIDTH * HEIGHT)
    return message


@neuros_initialise(outputs="image")
def begin(node):
    node.value = 1
    return image(node, node.value)


@neuros_function(inputs="seen", outputs=Optional("image"))
def check(node, seen):
    expected = node.value * 3 * WIDTH * HEIGHT
    if seen.data != expected:
        raise ValueError(f"image {node.value} arrived with the sum {seen.data}, not {expected}")
    if node.value == IMAGES:
        return node.shutdown(f"{IMAGES} images of {expected // node.value} bytes have arrived")
    node.value += 1
    return image(node, node.value)
