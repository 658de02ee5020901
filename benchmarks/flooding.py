"""Nodes that send as fast as their receivers allow, and nodes that count what arrives.

Each sender sends to all receivers. Every measurement returns ``rate`` in packets per second and
``volume`` in MB/s, of all receivers together. NeuROS sends no more than each receiver has room for.
With rclpy nothing holds a sender back, and what a receiver does not take in time is overwritten:
only what arrives is counted. With dora-rs the nodes themselves see to it that nothing is lost.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader

from benchmarks import dora
from benchmarks.launching import launch, project_of_plugins
from benchmarks.ping_pong import Packet
from benchmarks.processes import answer, program, ros_environment, running

QUEUE_SIZE = 16

_TIMEOUT_S = 60.0


def neuros(
    packet: Packet,
    backend: str,
    seconds: float,
    connection: dict[str, Any],
    options: Sequence[str] = (),
    *,
    senders: int = 1,
    receivers: int = 1,
) -> dict[str, float]:
    """From hook to hook, :data:`QUEUE_SIZE` packets in the input queue.

    Where the run is recorded, ``behind_s`` is how long after its last packet the bag was complete.
    """
    port = {"name": "ball", "type": packet.type}
    flood = {"container": "neuros_python", "plugin": "flood.py", "outputs": [port]}
    count = {"container": "neuros_python", "plugin": "count.py", "inputs": [port]}
    sources = [f"flood{number}" for number in range(senders)]
    sinks = [f"count{number}" for number in range(receivers)]
    project = {
        "nodes": [
            *({**flood, "name": n, "environment": {"BYTES": str(packet.size)}} for n in sources),
            *({**count, "name": n, "environment": {"SECONDS": str(seconds)}} for n in sinks),
        ],
        "connections": [
            {
                "source_node": source,
                "source_output": "ball",
                "destination_node": sink,
                "destination_input": "ball",
                "queue_size": QUEUE_SIZE,
                **connection,
            }
            for source in sources
            for sink in sinks
        ],
    }
    with project_of_plugins(project) as folder:
        launch(folder, folder / "run", backend, options=options)
        files = [folder / "run" / name / "result.json" for name in sinks]
        result = sum(json.loads(file.read_text()) for file in files)
        bags = [*(folder / "run" / "bag").glob("*.mcap")]
        behind = {"behind_s": max(map(_behind_s, bags))} if bags else {}
    return {**_figures(packet, result), **behind}


def _behind_s(bag: Path) -> float:
    """Seconds from the last packet to the last time that the bag was written to."""
    with Reader(bag.parent) as reader:
        return bag.stat().st_mtime - reader.end_time / 1e9


def bare(
    packet: Packet, seconds: float, *, senders: int = 1, receivers: int = 1
) -> dict[str, float]:
    """Loops around ``publish`` and ``rclpy.spin``, history depth :data:`QUEUE_SIZE`."""
    arguments = (packet.type, packet.type, packet.size, QUEUE_SIZE)
    with contextlib.ExitStack() as stack:
        environment = stack.enter_context(ros_environment())
        counts = [
            stack.enter_context(running(program("bare_rclpy", *each), environment))
            for each in [("count", *arguments, seconds)] * receivers
        ]
        for each in [("flood", *arguments)] * senders:
            stack.enter_context(running(program("bare_rclpy", *each), environment))
        return _figures(packet, sum(json.loads(answer(each, _TIMEOUT_S)) for each in counts))


def dora_rs(
    packet: Packet, seconds: float, *, senders: int = 1, receivers: int = 1
) -> dict[str, float]:
    """Nodes of dora-rs, at most :data:`QUEUE_SIZE` packets of a sender without an answer."""
    variables = {"BYTES": packet.size, "SECONDS": seconds, "WINDOW": QUEUE_SIZE}
    # Answers and packets under way, each at most a window: nothing is dropped.
    names = [f"flood{n}" for n in range(senders)], [f"count{n}" for n in range(receivers)]
    results = dora.run_all(*names, variables, queue_size=2 * QUEUE_SIZE)
    return _figures(packet, sum(results))


def _figures(packet: Packet, rate: float) -> dict[str, float]:
    return {"rate": rate, "volume": rate * packet.size / 1e6}
