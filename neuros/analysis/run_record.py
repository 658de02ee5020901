"""Record of a run (``run.json``): made from the last reports of its nodes, and read again."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

from neuros.control import Report
from neuros.engine.time_budget import time_budget_of
from neuros.errors import UsageError
from neuros.project.model import Connection, NodeFile, Project
from neuros.project.split import project_to_json
from neuros.recording.load_table import load_table
from neuros.recording.run_file import FORMAT, RUN_FILE, read_run_file

_COUNTS = ("sent", "received", "consumed", "discarded", "lost")


class Ended(Protocol):
    """Outcome of a run, as far as a record needs it."""

    exit_code: int
    reason: str
    reports: dict[str, Report]
    report_times_s: dict[str, float]
    timelines: dict[str, list[Sequence[float]]]
    started_s: float | None
    elsewhere: Mapping[str, Mapping[str, Any]]
    ending_s: float | None
    ended_s: float
    paused_s: float
    stacks: dict[str, str]

    @property
    def running_s(self) -> float | None: ...

    @property
    def real_time_factor(self) -> float | None: ...


def run_record(
    project: Project,
    files: Sequence[NodeFile],
    ended: Ended,
    wall_s: float,
    run_folder: Path,
) -> dict[str, Any]:
    """Everything that is known about a run, ready for JSON. Times are in seconds."""
    sim_times = [r.sim_time for r in ended.reports.values() if r.sim_time is not None]
    sim_s, all_ran_s = max(sim_times, default=None), ended.running_s
    all_metrics = {**ended.elsewhere, **{n: r.metrics or {} for n, r in ended.reports.items()}}
    return {
        "format": FORMAT,
        "project": project.name,
        "file": str(project.file),
        "exit_code": ended.exit_code,
        "reason": ended.reason,
        "wall_s": wall_s,
        "sim_s": sim_s,
        "running_s": all_ran_s,
        "paused_s": ended.paused_s,
        "real_time_factor": ended.real_time_factor,
        "timeline": {
            name: _timeline(points, ended) for name, points in ended.timelines.items() if points
        },
        "connections": [
            _connection(c, all_metrics, all_ran_s, run_folder, _cut_off(ended))
            for c in _connections(files)
        ],
        "nodes": {
            name: {
                **_node(name, ended),
                "results": _results(run_folder / name),
                **({"stack": ended.stacks[name]} if name in ended.stacks else {}),
            }
            for name in (file.node.name for file in files)
        },
        "expanded_project": project_to_json(project),
    }


def run_table(record: Mapping[str, Any]) -> str:
    """The record as text: connections, nodes, and times."""
    from tabulate import tabulate

    connections = tabulate(
        [[c["connection"], *(c[key] for key in _COUNTS)] for c in record["connections"]],
        headers=["connection", *_COUNTS],
        missingval="?",
        disable_numparse=True,
        colalign=("left", *("right" for _ in _COUNTS)) if record["connections"] else None,
    )
    nodes = tabulate(
        [[name, *_shares(node, record["running_s"])] for name, node in record["nodes"].items()],
        headers=["node", "executing", "waiting", "blocked", "idle", "remark"],
        missingval="?",
        disable_numparse=True,
        colalign=("left", "right", "right", "right", "right", "left"),
    )
    parts = [connections] if record["connections"] else []
    load = [load_table(record["system_load"])] if "system_load" in record else []
    return "\n\n".join([*parts, nodes, *load, _times(record)])


def consumed_percent(connection: Mapping[str, Any]) -> float | None:
    """The share of the packets sent on a connection that were consumed, in per cent."""
    sent, consumed = connection.get("sent"), connection.get("consumed")
    return 100 * consumed / sent if sent and consumed is not None else None


def _connections(files: Sequence[NodeFile]) -> list[Connection]:
    every = {connection for file in files for connection in file.connections}
    return sorted(every, key=lambda connection: connection.index)


def _timeline(points: Sequence[Sequence[float]], ended: Ended) -> list[list[float]]:
    """Points of simulated and wall time, both growing; wall time from the first hook on."""
    start_s = ended.started_s or 0.0
    found: list[list[float]] = []
    for sim_s, wall_s in points:
        if not found or int(sim_s) > int(found[-1][0]):
            found.append([round(sim_s, 6), round(wall_s - start_s, 6)])
    return found


def _connection(
    connection: Connection,
    all_metrics: Mapping[str, Mapping[str, Any]],
    running_s: float | None,
    run_folder: Path,
    cut_off: Collection[str],
) -> dict[str, Any]:
    from neuros.analysis.packets import packet_figures, read_packets

    key = str(connection)
    outgoing = all_metrics.get(connection.source_node, {}).get("outgoing", {}).get(key, {})
    incoming = all_metrics.get(connection.destination_node, {}).get("incoming", {}).get(key, {})
    fields = ("received", "consumed", "discarded", "unread", "longest_discard")
    sent, received = outgoing.get("sent"), incoming.get("received")
    # Counts that a node has last reported before it was killed are older than those of the other.
    is_known = not {connection.source_node, connection.destination_node} & set(cut_off)
    return {
        "connection": key,
        "index": connection.index,
        "discard_limit": connection.discard_limit,
        "queue_size": connection.queue_size,
        "sent": sent,
        "rate_hz": sent / running_s if sent is not None and running_s else None,
        "lost": sent - received if is_known and None not in (sent, received) else None,
        **{field: incoming.get(field) for field in fields},
        **packet_figures(
            read_packets(run_folder, connection),
            may_lose=not connection.is_reliable and sent != received,
        ),
    }


def _cut_off(ended: Ended) -> list[str]:
    """The nodes that have not reported their end."""
    return [name for name, report in ended.reports.items() if not report.is_final]


def _node(name: str, ended: Ended) -> dict[str, Any]:
    report = ended.reports.get(name)
    if report is None or report.metrics is None:
        return {"report": None}
    age_s = ended.ended_s - ended.report_times_s[name]
    metrics = report.metrics
    return {
        "accounting": metrics["accounting"],
        "hooks": metrics["hooks"],
        "sim_time": report.sim_time,
        "report": "final" if report.is_final else f"last report {age_s:.1f} s before the end",
    }


def _results(node_folder: Path) -> dict[str, Any]:
    """The results that the node's plugin has saved."""
    try:
        results = json.loads((node_folder / "results.json").read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return results if isinstance(results, dict) else {}


def _shares(node: Mapping[str, Any], running_s: float | None) -> list[str]:
    spent = time_budget_of(node, running_s)
    if spent is None:
        return ["?", "?", "?", "?", "never reported"]
    remark = "" if node["report"] == "final" else node["report"]
    if not spent.total_s:
        return ["-", "-", "-", "-", remark]
    return [*(f"{share:.0%}" for share in spent.shares.values()), remark]


def _times(record: Mapping[str, Any]) -> str:
    wall = f"wall time {record['wall_s']:.2f} s"
    if record.get("paused_s"):  # records of earlier versions do not say
        wall += f" ({record['paused_s']:.2f} s of it paused)"
    if record["sim_s"] is None:
        return wall
    return (
        f"simulated time {record['sim_s']:.2f} s, {wall}, real-time factor"
        f" {record['real_time_factor'] or 0:.2f} ({record['running_s'] or 0:.2f} s without"
        " initialisation and ending)"
    )


@dataclass(frozen=True)
class PastRun:
    """The folder of a run and its ``run.json``."""

    folder: Path
    record: Mapping[str, Any]

    @cached_property
    def connections(self) -> dict[str, Mapping[str, Any]]:
        """The figures of each connection, by ``a.out -> b.in``, in their order."""
        return {each["connection"]: each for each in self.record["connections"]}

    def connection(self, name: str) -> Connection:
        """A connection as the project has it."""
        return connection_of(name, self.connections[name])


def connection_of(name: str, figures: Mapping[str, Any]) -> Connection:
    """A connection as the project has it, from what ``run.json`` has of it."""
    (source, output), (destination, input_) = (end.split(".") for end in name.split(" -> "))
    limit, queue_size = figures.get("discard_limit"), figures.get("queue_size", 1)
    return Connection(source, output, destination, input_, limit, queue_size, figures["index"])


def open_run(folder: Path) -> PastRun:
    """Read a run folder.

    Raises:
        UsageError: if it is none, the run has not ended, or another version of NeuROS wrote it.
    """
    run = PastRun(folder, read_run_file(folder))
    try:
        _ = [run.connection(name) for name in run.connections]
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(
            f"{folder / RUN_FILE} is broken (its connections cannot be read: {error!r})"
        ) from error
    return run
