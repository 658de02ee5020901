"""A node of dora-rs: sends BYTES as fast as answers of all RECEIVERS allow, WINDOW without one.

The window is in here since dora-rs holds no sender back: it drops packets, and logs each of them.
"""

import os

import pyarrow
from dora import Node


def main() -> None:
    """Until it is told to stop."""
    node = Node()
    size = int(os.environ["BYTES"])
    ball = pyarrow.Array.from_buffers(pyarrow.uint8(), size, [None, pyarrow.py_buffer(bytes(size))])
    for _ in range(int(os.environ["WINDOW"])):
        node.send_output("ball", ball)
    left = receivers = int(os.environ["RECEIVERS"])
    for event in node:
        if event["type"] != "INPUT":
            break
        left -= 1
        if left == 0:
            left = receivers
            node.send_output("ball", ball)


if __name__ == "__main__":
    main()
