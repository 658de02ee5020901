"""A node of dora-rs: answers with 8 bytes; CORE, if there, is the only core to use."""

import os

if "CORE" in os.environ:
    os.sched_setaffinity(0, {int(os.environ["CORE"])})  # before dora starts threads

import pyarrow
from dora import Node


def main() -> None:
    """Until it is told to stop."""
    node, answer = Node(), pyarrow.array(bytes(8), type=pyarrow.uint8())
    for event in node:
        if event["type"] == "STOP":
            break
        if event["type"] == "INPUT":
            node.send_output(event["id"], answer)


if __name__ == "__main__":
    main()
