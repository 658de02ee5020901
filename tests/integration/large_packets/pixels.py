"""The pixels of an image by its number."""

import random


def pixels(number):
    """921,600 bytes."""
    return random.Random(number).randbytes(640 * 480 * 3)
