"""A node of dora-rs: answers each sender and counts for SECONDS; RESULT gets the rate per s."""

import json
import os
import time

import pyarrow
from dora import Node

WARM_UP = 200


def main() -> None:
    """Until enough is counted."""
    node, answer = Node(), pyarrow.array(bytes(8), type=pyarrow.uint8())
    length_ns = float(os.environ["SECONDS"]) * 1e9
    packets, start_ns, now_ns = -WARM_UP, 0, 0
    for event in node:
        if event["type"] != "INPUT":
            break
        packets += 1
        now_ns = time.perf_counter_ns()
        if packets <= 0:
            start_ns = now_ns
        elif now_ns - start_ns >= length_ns:
            break
        node.send_output(event["id"], answer)
    with open(os.environ["RESULT"], "w", encoding="utf-8") as file:
        json.dump(packets / (now_ns - start_ns) * 1e9, file)


if __name__ == "__main__":
    main()
