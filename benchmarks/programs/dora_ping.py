"""A node of dora-rs: sends BYTES, waits for the answer, and does it again, ROUND_TRIPS times.

RESULT is the file that gets their durations in microseconds; CORE, if there, the only core to use.
"""

import json
import os
import time

if "CORE" in os.environ:
    os.sched_setaffinity(0, {int(os.environ["CORE"])})  # before dora starts threads

import pyarrow
from dora import Node


def main() -> None:
    """Until all round trips are timed."""
    wanted, durations_us = int(os.environ["ROUND_TRIPS"]), []
    node = Node()
    size = int(os.environ["BYTES"])
    ball = pyarrow.Array.from_buffers(pyarrow.uint8(), size, [None, pyarrow.py_buffer(bytes(size))])
    start_ns = time.perf_counter_ns()
    node.send_output("ball", ball)
    for event in node:
        if event["type"] != "INPUT":
            break
        now_ns = time.perf_counter_ns()
        durations_us.append((now_ns - start_ns) / 1e3)
        if len(durations_us) == wanted:
            break
        start_ns = now_ns
        node.send_output("ball", ball)
    with open(os.environ["RESULT"], "w", encoding="utf-8") as file:
        json.dump(durations_us, file)


if __name__ == "__main__":
    main()
