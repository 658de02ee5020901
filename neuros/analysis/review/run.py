"""Run folder opened for review, also of a run that was cut off.

:mod:`neuros.analysis.run_record` refuses what it cannot rely on; a review shows what there is, and
says what is missing.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from neuros.analysis.packets import FOLDER, Numbers, Packets, packet_figures, read_packets
from neuros.analysis.run_record import connection_of
from neuros.backends.registered import ran_in_one_process
from neuros.engine.time_budget import TimeBudget, time_budget_of
from neuros.errors import UsageError
from neuros.project.model import Connection
from neuros.recording.load_table import FILE_NAME
from neuros.recording.run_file import RUN_FILE, read_run_file


@dataclass(frozen=True)
class Run:
    """Run folder that is open for review.

    Attributes:
        record: ``run.json``, or as much of it as the project and the packet lists give.
        connections: by ``a.out -> b.in``, as in ``run.json``.
        nodes: by name, as in ``run.json``; without ``accounting`` where a node never reported.
        missing: a sentence for each thing that could not be told.
    """

    folder: Path
    record: Mapping[str, Any]
    connections: Mapping[str, Mapping[str, Any]]
    nodes: Mapping[str, Mapping[str, Any]]
    missing: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name for headings."""
        return f"{self.record.get('project', '?')} ({self.folder.name})"

    @property
    def running_s(self) -> float | None:
        """Wall time in which all nodes ran."""
        found: float | None = self.record.get("running_s")
        return found

    @property
    def is_one_process(self) -> bool:
        """Whether all nodes took turns in one thread."""
        return ran_in_one_process(self.record)

    @property
    def time_owner(self) -> str | None:
        """The node that owns simulated time."""
        return next((n for n in self.nodes if self.nodes[n].get("sim_time") is not None), None)

    @cached_property
    def ends(self) -> dict[str, Connection]:
        """The connections as a project has them, by name."""
        return {name: connection_of(name, figures) for name, figures in self.connections.items()}

    @cached_property
    def time_budgets(self) -> dict[str, TimeBudget]:
        """Time budget of each node that has reported."""
        found = {name: time_budget_of(node, self.running_s) for name, node in self.nodes.items()}
        return {name: spent for name, spent in found.items() if spent is not None}

    @cached_property
    def packets(self) -> dict[str, Packets]:
        """The packet lists of every connection."""
        return {
            name: read_packets(self.folder, connection) for name, connection in self.ends.items()
        }

    @cached_property
    def traces(self) -> dict[str, Trace]:
        """The first executions of every node that has listed them."""
        found = {name: read_trace(self.folder / name / FOLDER) for name in self.nodes}
        return {name: trace for name, trace in found.items() if len(trace.starts_ns)}


def open_for_review(folder: Path) -> Run:
    """Read what there is in a run folder.

    Raises:
        UsageError: if no run has left it behind, the run goes on, or another version wrote it.
    """
    try:
        record, missing = _read_record(folder)
        connections = {each["connection"]: each for each in record.get("connections", ())}
        nodes = {name: dict(node) for name, node in record.get("nodes", {}).items()}
        run = Run(folder, record, connections, nodes, ())
        missing += _missing_lists(run)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise UsageError(f"{folder / 'run.json'} is broken: it does not describe a run") from error
    return replace(run, missing=tuple(missing))


def _read_record(folder: Path) -> tuple[dict[str, Any], list[str]]:
    if not (folder / RUN_FILE).exists():
        return _from_project(folder)
    return read_run_file(folder), []


def _from_project(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """A record from files that were written before and during the run."""
    if not (folder / "project.json").is_file():
        raise UsageError(f"{folder} has no run.json: it is no folder that a run has left behind")
    project = _json(folder / "project.json")
    connections = []
    for index, each in enumerate(project.get("connections", ())):
        name = (
            f"{each['source_node']}.{each['source_output']} ->"
            f" {each['destination_node']}.{each['destination_input']}"
        )
        figures = {
            "connection": name,
            "index": index,
            "discard_limit": each.get("discard_limit"),
            "queue_size": each.get("queue_size", 1),
        }
        packets = read_packets(folder, connection_of(name, figures))
        sent, received = len(packets.sent_ns), len(packets.received)
        figures |= {"sent": sent, "received": received, "consumed": len({*packets.taken.tolist()})}
        may_lose = figures["discard_limit"] is None and sent != received
        connections.append(figures | packet_figures(packets, may_lose=may_lose))
    nodes = {node["name"]: {"report": None} for node in project.get("nodes", ())}
    record = {
        "project": folder.parent.name if folder.parent.parent.name == "runs" else folder.name,
        "reason": "the run goes on, or its launcher was killed",
        "connections": connections,
        "nodes": nodes,
        "expanded_project": project,
    }
    return record, [
        "run.json: the run goes on, or its launcher was killed. Packets are counted from the"
        " nodes' lists (up to a second before the end); how nodes spent their time, losses and"
        " ticks are not known, and so the bottleneck cannot be told"
    ]


def _missing_lists(run: Run) -> list[str]:
    missing = []
    silent = [name for name, node in run.nodes.items() if not node.get("accounting")]
    if silent and len(silent) < len(run.nodes):
        missing.append(f"what {', '.join(silent)} did with its time: it never reported")
    if not (run.folder / FILE_NAME).is_file():
        missing.append("processor and memory: the run was made without -m")
    if not any(len(packets.sent_ns) for packets in run.packets.values()) and run.connections:
        missing.append("times of single packets: no node has listed any")
    if not run.traces and run.nodes:
        missing.append("the first executions of hooks: no node has listed any")
    return missing


def _json(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text("utf-8"))
    except FileNotFoundError:
        raise
    except OSError as error:
        raise UsageError(f"{file} cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise UsageError(f"{file} is broken ({error}): was the disk full?") from error
    if not isinstance(found, dict):
        raise UsageError(f"{file} is broken: it holds no object")
    return found


@dataclass(frozen=True)
class Trace:
    """First executions of a node's hooks; times of the monotonic clock, in nanoseconds.

    Attributes:
        hooks: name and kind of each hook that ran.
        which: of each execution, its hook's place in ``hooks``, (executions,).
        starts_ns, ends_ns: from when to when, (executions,).
        credits: index of the connection, position and arrival of each acknowledgement, (n, 3).
    """

    hooks: tuple[tuple[str, str], ...]
    which: Numbers
    starts_ns: Numbers
    ends_ns: Numbers
    credits: Numbers

    @property
    def is_running(self) -> Numbers:
        """Which executions were not of initialise hooks, (executions,)."""
        initialisers = [i for i, (_, kind) in enumerate(self.hooks) if kind == "initialise"]
        found: Numbers = ~np.isin(self.which, initialisers)
        return found


def read_trace(folder: Path) -> Trace:
    """Read the lists of a node; empty where there are none."""
    executions = _triples(folder / "executions")
    try:
        hooks = json.loads((folder / "hooks.json").read_text("utf-8"))
        names = [(str(hook["name"]), str(hook["kind"])) for hook in hooks]
    except (OSError, ValueError, TypeError, KeyError):
        names = []
    # A node that was killed may have listed a hook's execution, and not its name.
    count = int(executions[:, 0].max()) + 1 if len(executions) else 0
    names += [(f"hook {place + 1}", "function") for place in range(len(names), count)]
    which, starts_ns, ends_ns = executions.T
    return Trace(tuple(names), which, starts_ns, ends_ns, _triples(folder / "credits"))


def _triples(file: Path) -> Numbers:
    try:
        data = file.read_bytes()
    except OSError:
        data = b""
    return np.frombuffer(data[: len(data) // 24 * 24], np.int64).reshape(-1, 3)
