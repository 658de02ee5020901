"""The projects of the load tests: a ring of four, a star from one to 16, one from 16 to one.

Beside the lossless connections each has some with other limits, which must neither lose more than
their limit says nor disturb the others.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

NODES = Path(__file__).parent / "nodes"
ARMS = 16
LARGEST_BYTES = 8 << 20
_QUEUE_SIZES = (1, 2, 4, 8)
_IMAGE = "sensor_msgs/msg/Image"


@dataclass(frozen=True)
class Shape:
    """Nodes and connections.

    Attributes:
        plugins: of each node.
        ends: source, destination, discard limit and queue size of each connection.
    """

    plugins: dict[str, str]
    ends: list[tuple[str, str, int | None, int]]

    @property
    def lossless(self) -> int:
        """How many connections lose nothing: so many packets go out for one of each sender."""
        return sum(limit == 0 for _, _, limit, _ in self.ends)

    def write(self, folder: Path, packets: int, largest: int, mark: str) -> int:
        """Write the project into ``folder``; returns how many packets each sender has to send.

        Args:
            packets: on all lossless connections together.
            largest: bytes of the largest packets.
            mark: ``LOAD_MARK`` in the environment of all nodes.
        """
        count = max(1, packets // self.lossless)
        environment = {"COUNT": str(count), "LARGEST": str(largest), "LOAD_MARK": mark}
        nodes: list[dict[str, Any]] = []
        for name, plugin in self.plugins.items():
            node = {"name": name, "container": "neuros_python", "plugin": f"{plugin}.py"}
            ports: dict[str, Any] = {"environment": {**environment, "SHUTDOWN": "1"}}
            if any(name == end[0] for end in self.ends):
                ports["outputs"] = [{"name": "o", "type": _IMAGE}]
            if any(name == end[1] for end in self.ends):
                ports["inputs"] = [{"name": "x", "type": _IMAGE}]
            if "gather" in self.plugins.values():
                ports["environment"]["SHUTDOWN"] = "0"
            nodes.append({**node, **ports})
        connections = [
            {
                "source_node": source,
                "source_output": "o",
                "destination_node": destination,
                "destination_input": "x",
                "queue_size": queue_size,
                **({} if limit is None else {"discard_limit": limit}),
            }
            for source, destination, limit, queue_size in self.ends
        ]
        for name in {"traffic", *self.plugins.values()}:
            shutil.copy(NODES / f"{name}.py", folder)
        project = {"nodes": nodes, "connections": connections}
        (folder / "project.json").write_text(json.dumps(project, indent=1))
        return count


def _ring() -> Shape:
    names = [f"n{k}" for k in range(4)]
    ends = [(a, b, 0, q) for a, b, q in zip(names, [*names[1:], "n0"], _QUEUE_SIZES, strict=True)]
    plugins = {**dict.fromkeys(names, "relay"), "some": "sink"}
    return Shape(plugins, [*ends, ("n0", "some", 3, 1), ("n2", "some", None, 1)])


def _one_to_many() -> Shape:
    names = [f"r{k}" for k in range(ARMS)]
    limits: list[int | None] = [*[0] * (ARMS - 4), 1, 7, None, None]
    plugins = {"source": "source", **dict.fromkeys(names, "sink")}
    ends = [
        ("source", name, limit, _QUEUE_SIZES[k % 4])
        for k, (name, limit) in enumerate(zip(names, limits, strict=True))
    ]
    return Shape(plugins, ends)


def _many_to_one() -> Shape:
    names = [f"s{k}" for k in range(ARMS)]
    plugins = {**dict.fromkeys(names, "source"), "gather": "gather", "some": "sink"}
    ends: list[tuple[str, str, int | None, int]] = [
        (name, "gather", 0, _QUEUE_SIZES[k % 4]) for k, name in enumerate(names)
    ]
    return Shape(plugins, [*ends, ("s0", "some", 3, 1), ("s1", "some", None, 1)])


SHAPES: dict[str, Callable[[], Shape]] = {
    "ring": _ring,
    "1-to-16": _one_to_many,
    "16-to-1": _many_to_one,
}
