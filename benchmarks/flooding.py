"""One node that sends as fast as its receiver allows, and one that counts what arrives.

Every measurement returns ``rate`` in packets per second and ``volume`` in MB/s. NeuROS sends no
more than the receiver has room for. With rclpy nothing holds the sender back, and what the receiver
does not take in time is overwritten: only what arrives is counted. With dora-rs the two nodes
themselves see to it that nothing is lost.
"""

from __future__ import annotations

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
) -> dict[str, float]:
    """From hook to hook, :data:`QUEUE_SIZE` packets in the input queue.

    Where the run is recorded, ``behind_s`` is how long after its last packet the bag was complete.
    """
    port = {"name": "ball", "type": packet.type}
    sender = {"name": "flood", "container": "neuros_python", "plugin": "flood.py"}
    receiver = {"name": "count", "container": "neuros_python", "plugin": "count.py"}
    ends = {
        "source_node": "flood",
        "source_output": "ball",
        "destination_node": "count",
        "destination_input": "ball",
    }
    project = {
        "nodes": [
            {**sender, "outputs": [port], "environment": {"BYTES": str(packet.size)}},
            {**receiver, "inputs": [port], "environment": {"SECONDS": str(seconds)}},
        ],
        "connections": [{**ends, "queue_size": QUEUE_SIZE, **connection}],
    }
    with project_of_plugins(project) as folder:
        launch(folder, folder / "run", backend, options=options)
        result = json.loads((folder / "run" / "count" / "result.json").read_text())
        bags = [*(folder / "run" / "bag").glob("*.mcap")]
        behind = {"behind_s": max(map(_behind_s, bags))} if bags else {}
    return {**_figures(packet, result), **behind}


def _behind_s(bag: Path) -> float:
    """Seconds from the last packet to the last time that the bag was written to."""
    with Reader(bag.parent) as reader:
        return bag.stat().st_mtime - reader.end_time / 1e9


def bare(packet: Packet, seconds: float) -> dict[str, float]:
    """A loop around ``publish`` and ``rclpy.spin``, history depth :data:`QUEUE_SIZE`."""
    arguments = (packet.type, packet.type, packet.size, QUEUE_SIZE)
    with (
        ros_environment() as environment,
        running(program("bare_rclpy", "count", *arguments, seconds), environment) as count,
        running(program("bare_rclpy", "flood", *arguments), environment),
    ):
        return _figures(packet, json.loads(answer(count, _TIMEOUT_S)))


def dora_rs(packet: Packet, seconds: float) -> dict[str, float]:
    """Two nodes of dora-rs, at most :data:`QUEUE_SIZE` packets without an answer."""
    variables = {"BYTES": packet.size, "SECONDS": seconds, "WINDOW": QUEUE_SIZE}
    # Answers and packets under way, each at most a window: nothing is dropped.
    result = dora.run("flood", "count", variables, queue_size=2 * QUEUE_SIZE)
    return _figures(packet, result)


def _figures(packet: Packet, rate: float) -> dict[str, float]:
    return {"rate": rate, "volume": rate * packet.size / 1e6}
