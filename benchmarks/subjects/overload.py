"""What a node that cannot follow works on: the greatest age of packets, the longest wait of hooks.

Against bare rclpy with the same topics and callbacks, on ``SingleThreadedExecutor`` and on
``EventsExecutor``: the better one of the two in each figure.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

from benchmarks.bare_nodes import results
from benchmarks.graphs import lossless, run
from benchmarks.measure import Case, Figure, Group, Subject

TIME = "std_msgs/msg/Int64"
BETTER = "rclpy, the better executor"
ROUNDS = 10


class Load(NamedTuple):
    """Seconds between two packets of each input, and those that each packet takes.

    ``has_command``: nothing of the other input may be lost.
    """

    name: str
    fast_s: float
    other_s: float
    fast_takes_s: float
    other_takes_s: float
    has_command: bool

    @property
    def settings(self) -> dict[str, str]:
        """The environment of the plugins."""
        names = ("fast_s", "other_s", "fast_takes_s", "other_takes_s")
        return {name.upper(): str(getattr(self, name)) for name in names}


LOADS = (
    Load("camera at 100 Hz into a hook of 100 ms, command at 5 Hz", 0.01, 0.2, 0.1, 0.0, True),
    Load("two inputs at 50 Hz into hooks of 150 ms", 0.02, 0.02, 0.15, 0.15, False),
)


def subject(is_quick: bool) -> Subject:
    """Long enough for a backlog to show."""
    seconds = 2.0 if is_quick else 8.0
    return Subject(
        "age of packets and waits of hooks under overload",
        tuple(_group(load, seconds) for load in LOADS),
    )


def _group(load: Load, seconds: float) -> Group:
    candidates = {
        "process": functools.partial(neuros, load, "process", seconds),
        "in process": functools.partial(neuros, load, "in-process", seconds),
        BETTER: functools.partial(better_executor, load, seconds),
    }
    names = ("camera", "command") if load.has_command else ("one input", "other input")
    judged = ("process", "other age") if load.has_command else ("process", "other wait")
    cases = []
    for label, (key, name) in itertools.product(
        ("process", "in process"), zip(("fast", "other"), names, strict=True)
    ):
        for what, words in (("age", "greatest age"), ("wait", "longest wait")):
            figure = f"{key} {what}"
            is_judged = (label, figure) == judged
            cases.append(
                Case(
                    f"{load.name}, {label}: {words} of {name}",
                    "ms",
                    Figure(label, figure),
                    Figure(BETTER, figure),
                    BETTER,
                    f"overload-{what}" if is_judged else None,
                )
            )
    return Group(candidates, tuple(cases), ROUNDS)


def neuros(load: Load, backend: str, seconds: float) -> dict[str, float]:
    """By input, its age and its wait, in ms."""
    ports = [{"name": name, "type": TIME} for name in ("fast", "other")]
    source = {"name": "source", "plugin": "too_fast.py", "outputs": ports}
    sink = {"name": "sink", "plugin": "too_slow.py", "inputs": ports}
    environment = {**load.settings, "SECONDS": str(seconds)}
    nodes = [
        {**node, "container": "neuros_python", "environment": environment}
        for node in (source, sink)
    ]
    command, camera = (lossless(f"source.{name}", f"sink.{name}") for name in ("other", "fast"))
    del camera["discard_limit"]
    if load.has_command:
        command["queue_size"] = 8
    else:
        del command["discard_limit"]
    connections = [camera, command]
    found: dict[str, float] = run(nodes, connections, backend, ["sink"])[0]
    return found


def better_executor(load: Load, seconds: float) -> dict[str, float]:
    """The smaller figure of the two executors of rclpy, each."""
    single, events = (_bare(load, executor, seconds) for executor in ("single", "events"))
    return {name: min(value, events[name]) for name, value in single.items()}


def _bare(load: Load, executor: str, seconds: float) -> Mapping[str, float]:
    reliable = [False, load.has_command]
    source: dict[str, Any] = {
        "role": "too fast",
        "periods_s": [load.fast_s, load.other_s],
        "reliable": reliable,
    }
    sink = {
        "role": "too slow",
        "takes_s": [load.fast_takes_s, load.other_takes_s],
        "reliable": reliable,
        "seconds": seconds,
        "executor": executor,
    }
    (found,) = results([[source], [sink]], [1])
    return dict(found)
