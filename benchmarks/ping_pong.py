"""A packet there and one back: hook to hook with NeuROS, and without it, placed alike.

Every measurement returns ``median``, ``p90`` and ``p99`` of the durations in microseconds, after
:data:`WARM_UP` that do not count.
"""

from __future__ import annotations

import contextlib
import json
import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import dora
from benchmarks.launching import launch, project_of_plugins
from benchmarks.processes import answer, cores, program, ros_environment, running, two_cores

WARM_UP = 500

STRING, IMU, IMAGE = "std_msgs/msg/String", "sensor_msgs/msg/Imu", "sensor_msgs/msg/Image"

UNPINNED, CORE_EACH, ONE_CORE = "unpinned", "a core each", "one core"
KERNEL = "left to the kernel"
"""``--no-placement``: what *unpinned* means as long as the default pins nothing."""

_TIMEOUT_S = 120.0


@dataclass(frozen=True)
class Packet:
    """What travels: its name in the table, its type, its size in bytes, what comes back."""

    name: str
    type: str
    size: int
    back: str

    @property
    def answer(self) -> str:
        """The plugin that sends back: the same packet, or a small one."""
        return "echo.py" if self.back == self.type else "answer.py"


SMALL = Packet("8 B", STRING, 8, STRING)
IMU_PACKET = Packet("IMU", IMU, 324, IMU)
MEDIUM = Packet("64 kB", IMAGE, 65_536, STRING)
LARGE = Packet("921,600 B", IMAGE, 921_600, STRING)
PACKETS = (SMALL, IMU_PACKET, MEDIUM, LARGE)


def neuros(
    packet: Packet,
    backend: str,
    count: int,
    place: str = UNPINNED,
    connection: dict[str, Any] | None = None,
) -> dict[str, float]:
    """From hook to hook and back, lossless if ``connection`` says nothing else."""
    with placed_project(packet, count + WARM_UP, place, connection) as folder:
        launch(folder, folder / "run", backend, options=options_of(place))
        return _figures(json.loads((folder / "run" / "ping" / "result.json").read_text()))


@contextlib.contextmanager
def placed_project(
    packet: Packet, round_trips: int, place: str, connection: dict[str, Any] | None = None
) -> Iterator[Path]:
    """The folder of a project that makes so many round trips, and then ends."""
    project = _project(packet, round_trips, connection or {"discard_limit": 0})
    if place in (CORE_EACH, ONE_CORE):
        for node, chosen in zip(project["nodes"], _cores_of_two(place), strict=True):
            node["affinity"] = list(chosen)
    with project_of_plugins(project) as folder:
        yield folder


def options_of(place: str) -> list[str]:
    """What ``neuros launch`` is told about it."""
    return ["--no-placement"] if place == KERNEL else []


def bare(
    packet: Packet, count: int, place: str = UNPINNED, profiles: Path | None = None
) -> dict[str, float]:
    """Two processes that use nothing but ``rclpy.spin``, nothing acknowledged.

    Args:
        profiles: settings of Fast DDS, instead of its own.
    """
    first, second = _cores_of_two(place)
    arguments = (packet.type, packet.back, packet.size, 1)
    with (
        ros_environment(profiles) as environment,
        running(program("bare_rclpy", "echo", *arguments), environment, first),
        running(
            program("bare_rclpy", "ping", *arguments, count + WARM_UP), environment, second
        ) as ping,
    ):
        return _figures(json.loads(answer(ping, _TIMEOUT_S)))


def bare_one_process(packet: Packet, count: int) -> dict[str, float]:
    """Two nodes in one executor of one process."""
    arguments = (packet.type, packet.back, packet.size, 1, count + WARM_UP)
    with (
        ros_environment() as environment,
        running(program("bare_rclpy", "both", *arguments), environment) as both,
    ):
        return _figures(json.loads(answer(both, _TIMEOUT_S)))


def dora_rs(packet: Packet, count: int, place: str = UNPINNED) -> dict[str, float]:
    """Two nodes of dora-rs, 8 bytes back."""
    chosen = None
    if place == CORE_EACH:
        chosen = two_cores()
    elif place == ONE_CORE:
        chosen = (cores()[0], cores()[0])
    variables = {"BYTES": packet.size, "ROUND_TRIPS": count + WARM_UP}
    return _figures(dora.run("ping", "pong", variables, chosen=chosen))


def _cores_of_two(place: str) -> tuple[Sequence[int], Sequence[int]]:
    if place == CORE_EACH:
        first, second = two_cores()
        return [first], [second]
    if place == ONE_CORE:
        return cores()[:1], cores()[:1]
    return cores(), cores()


def _figures(durations_us: Sequence[float]) -> dict[str, float]:
    counted = sorted(durations_us[WARM_UP:])
    p90, p99 = (counted[math.ceil(share * len(counted)) - 1] for share in (0.9, 0.99))
    return {"median": statistics.median(counted), "p90": p90, "p99": p99}


def _project(packet: Packet, round_trips: int, connection: dict[str, Any]) -> dict[str, Any]:
    variables = {"ROUND_TRIPS": str(round_trips), "BYTES": str(packet.size)}
    ping = {"name": "ping", "container": "neuros_python", "plugin": "ping.py"}
    echo = {"name": "echo", "container": "neuros_python", "plugin": packet.answer}
    ball = {"name": "ball", "type": packet.type}
    back = {"name": "back", "type": packet.back}
    there = _ends("ping", "ball", "echo", "ball")
    here = _ends("echo", "back", "ping", "back")
    return {
        "nodes": [
            {**ping, "inputs": [back], "outputs": [ball], "environment": variables},
            {**echo, "inputs": [ball], "outputs": [back]},
        ],
        "connections": [there | connection, here | connection],
    }


def _ends(source: str, output: str, destination: str, input_name: str) -> dict[str, Any]:
    return {
        "source_node": source,
        "source_output": output,
        "destination_node": destination,
        "destination_input": input_name,
    }
