"""How long a packet needs there and back: hook to hook, acknowledged, nothing ever lost.

Between two processes it is compared with a ping-pong of bare ``rclpy.spin`` (same message, same
depth and reliability, no acknowledgements), once as it comes and once with NeuROS's settings of
Fast DDS. In one process a *hop* is half a round trip: from one
hook to the next, with the acknowledgement, scheduling, and the change from node to node.
"""

from __future__ import annotations

import functools
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.launching import cores, launch, on_cores, project_of_plugins
from benchmarks.measure import Measurement, Row, Target, in_rounds
from neuros.launch.domain import choose_domain
from neuros.transport.ros_process import PROFILES, PROFILES_VARIABLE

ROOT = Path(__file__).resolve().parents[1]
STRING, IMU = "std_msgs/msg/String", "sensor_msgs/msg/Imu"
WARM_UP = 500


def measure(is_quick: bool, say: Callable[[str], None]) -> list[Row]:
    """All rows of this module."""
    count, rounds = (1000, 2) if is_quick else (4000, 9)
    candidates: dict[str, Measurement] = {
        "rclpy": functools.partial(bare_us, count),
        "process": functools.partial(neuros_us, STRING, "process", count),
        "String": lambda: neuros_us(STRING, "in-process", count) / 2,
        "Imu": lambda: neuros_us(IMU, "in-process", count) / 2,
    }
    if len(cores()) > 1:
        candidates |= {
            "rclpy, a core each": functools.partial(bare_us, count, is_pinned=True),
            "rclpy, a core each, tuned": functools.partial(
                bare_us, count, is_pinned=True, is_tuned=True
            ),
            "process, a core each": functools.partial(
                neuros_us, STRING, "process", count, own_core="echo"
            ),
        }
    values = in_rounds(candidates, rounds, say)
    rows = [
        _round_trip(values, "process", "rclpy", Target(1.0)),
        _round_trip(values, "process, a core each", "rclpy, a core each", Target(1.0)),
        _round_trip(values, "process, a core each", "rclpy, a core each, tuned"),
    ]
    return [
        *(row for row in rows if row is not None),
        Row("hop of a String in process", "us", values["String"], target=Target(25)),
        Row("hop of an Imu in process", "us", values["Imu"], target=Target(45)),
    ]


def _round_trip(
    values: Mapping[str, tuple[float, ...]], name: str, bare: str, target: Target | None = None
) -> Row | None:
    if name not in values:
        return None
    reference = (bare.replace("rclpy", "rclpy.spin"), values[bare])
    return Row(f"round trip of a String, {name}", "us", values[name], reference, target)


def neuros_us(kind: str, backend: str, count: int, own_core: str | None = None) -> float:
    """Median round trip from hook to hook and back, in microseconds."""
    with project_of_plugins(_project(kind, count + WARM_UP)) as folder:
        launch(folder, folder / "run", backend, own_core=own_core)
        return _median(json.loads((folder / "run" / "ping" / "result.json").read_text()))


def bare_us(count: int, *, is_pinned: bool = False, is_tuned: bool = False) -> float:
    """The same between two processes that use nothing but rclpy.

    ``is_tuned``: with NeuROS's settings of Fast DDS instead of the default ones.
    """
    first, *others = [[core] for core in cores()] if is_pinned else [cores(), cores()]
    with choose_domain(None, {}, False) as domain:
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain.id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        if is_tuned:
            environment[PROFILES_VARIABLE] = str(PROFILES)
        echo = _bare(["echo"], first, environment)
        try:
            ping = _bare(["ping", str(count + WARM_UP)], others[0], environment)
            output, _ = ping.communicate(timeout=60)
        finally:
            echo.communicate(timeout=10)  # closes its input
    return _median(json.loads(output))


def _bare(
    arguments: Sequence[str], chosen: Sequence[int], environment: Mapping[str, str]
) -> subprocess.Popen[str]:
    with on_cores(chosen):
        return subprocess.Popen(
            [sys.executable, "-m", "benchmarks.bare_rclpy", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=environment,
        )


def _median(durations_us: Sequence[float]) -> float:
    return statistics.median(durations_us[WARM_UP:])


def _project(kind: str, round_trips: int) -> dict[str, Any]:
    return {
        "nodes": [
            {
                "name": "ping",
                "container": "neuros_python",
                "plugin": "ping.py",
                "inputs": [{"name": "back", "type": kind}],
                "outputs": [{"name": "ball", "type": kind}],
                "environment": {"ROUND_TRIPS": str(round_trips)},
            },
            {
                "name": "echo",
                "container": "neuros_python",
                "plugin": "echo.py",
                "inputs": [{"name": "ball", "type": kind}],
                "outputs": [{"name": "back", "type": kind}],
            },
        ],
        "connections": [_lossless("ping.ball", "echo.ball"), _lossless("echo.back", "ping.back")],
    }


def _lossless(source: str, destination: str) -> dict[str, Any]:
    (source_node, output), (destination_node, input_name) = (
        end.split(".") for end in (source, destination)
    )
    return {
        "source_node": source_node,
        "source_output": output,
        "destination_node": destination_node,
        "destination_input": input_name,
        "discard_limit": 0,
    }
