"""Run folders made by hand, as runs leave them behind."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neuros.project.model import Connection

PACKETS = 50
PERIOD_NS = 10_000_000


def accounting(**spent: Any) -> dict[str, Any]:
    """Seconds by cause; what is not given is nothing."""
    nothing: dict[str, Any] = {
        "executing": {}, "waiting": {}, "blocked": {}, "idle": 0.0, "registering": 0.0,
        "scheduling": 0.0,
    }  # fmt: skip
    return nothing | spent


def wires(**limits: int | None) -> dict[str, Connection]:
    """Connections ``a_b=0``: from output ``out`` of a to input ``in`` of b, and its limit."""
    found = {}
    for index, (ends, limit) in enumerate(limits.items()):
        source, destination = ends.split("_")
        connection = Connection(source, "out", destination, f"in_{source}", limit, 1, index)
        found[str(connection)] = connection
    return found


def run_folder(
    folder: Path, limits: Mapping[str, int | None], nodes: Mapping[str, Any], /, **more: Any
) -> Path:
    """A run of 10 s with these discard limits by connection, and accounting by node.

    Each connection carries a packet per 10 ms, taken 5 ms later; each node has one execution of
    its first hook per packet.
    """
    connections = [
        _connection(folder, name, index, limit)
        for index, (name, limit) in enumerate(limits.items())
    ]
    for name, spent in nodes.items():
        _write_trace(folder / name / "packets", [*(spent or {"executing": ["hook"]})["executing"]])
    record = {
        "format": 2,
        "project": "made",
        "file": "made/project.json",
        "backend": "process",
        "exit_code": 0,
        "reason": "ended",
        "wall_s": 12.0,
        "running_s": 10.0,
        "sim_s": None,
        "real_time_factor": None,
        "timeline": {},
        "connections": connections,
        "nodes": {name: _node(spent) for name, spent in nodes.items()},
        **more,
    }
    (folder / "run.json").write_text(json.dumps(record))
    return folder


def _node(spent: Any) -> dict[str, Any]:
    if spent is None:
        return {"report": None}
    hooks = {name: {"executions": PACKETS} for name in spent["executing"]}
    if "init" in hooks:
        hooks["init"]["initialise_s"] = spent["executing"]["init"]
    return {"accounting": spent, "hooks": hooks, "sim_time": None, "report": "final"}


def _connection(folder: Path, name: str, index: int, limit: int | None) -> dict[str, Any]:
    source, destination = (end.split(".")[0] for end in name.split(" -> "))
    times = np.arange(PACKETS, dtype=np.int64) * PERIOD_NS + 1_000_000_000
    lists = (
        (source, "sent_ns", times),
        (destination, "taken", np.arange(1, PACKETS + 1, dtype=np.int64)),
        (destination, "taken_ns", times + 5_000_000),
    )
    for node, what, numbers in lists:
        (folder / node / "packets").mkdir(parents=True, exist_ok=True)
        (folder / node / "packets" / f"{index}.{what}").write_bytes(numbers.tobytes())
    return {
        "connection": name,
        "index": index,
        "discard_limit": limit,
        "queue_size": 1,
        "sent": PACKETS,
        "received": PACKETS,
        "consumed": PACKETS,
        "discarded": 0,
        "lost": 0,
        "longest_discard": 0,
        "rate_hz": PACKETS / 10,
        "latency_ms": {"p50": 5.0, "p90": 5.0, "p99": 5.0, "max": 5.0, "count": PACKETS},
        "digests": None,
    }


def _write_trace(folder: Path, hooks: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    starts = np.arange(PACKETS, dtype=np.int64) * PERIOD_NS + 1_005_000_000
    rows = np.column_stack([np.zeros_like(starts), starts, starts + 3_000_000])
    (folder / "executions").write_bytes(rows.tobytes())
    kinds = [{"name": h, "kind": "initialise" if h == "init" else "function"} for h in hooks]
    (folder / "hooks.json").write_text(json.dumps(kinds))
