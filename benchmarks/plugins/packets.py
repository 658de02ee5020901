"""Packets of a given size, for plugins and for programs without NeuROS."""

import array


def fill(packet, size):
    """Give a String that many characters, an Image that many bytes; others stay as they are."""
    if type(packet).__name__ == "Image":
        packet.height, packet.width, packet.step, packet.encoding = 1, size, size, "mono8"
        packet.data = array.array("B", bytes(size))
    elif type(packet).__name__ == "String":
        packet.data = "x" * size
    return packet
