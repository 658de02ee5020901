"""Reading of runs for reports: all that a run folder holds, and what is missing.

:func:`open_for_review` also reads a run that goes on, was cut off, or is of an earlier version,
which :func:`neuros.api.run_record.open_run` refuses.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from neuros.api.packets import (
    FOLDER,
    Numbers,
    PacketLists,
    may_have_lost,
    numbers_of,
    packet_figures,
    read_packets,
    up_to_first,
)
from neuros.api.run_record import PastRun, connection_of
from neuros.engine.metrics import TimeBudget, time_budget_of
from neuros.errors import EnvironmentFault, UsageError
from neuros.project.scanner import read_bytes
from neuros.recording.run_file import RUN_FILE, check_record, read_object, read_run_file
from neuros.recording.system_load import FILE_NAME
from neuros.registry import ran_in_one_process

_MOST = 2.0**63  # of a measured value; the axes of a figure cannot be longer
_MOST_HOOKS = 10_000


@dataclass(frozen=True)
class Trace:
    """First executions of a node's hooks; times of the monotonic clock, in nanoseconds.

    Attributes:
        hooks: name and kind of each hook that ran.
        which: the place in ``hooks`` of each execution's hook, (executions,).
        starts_ns, ends_ns: of each execution, (executions,).
        credits: index of the connection, position and arrival of each acknowledgement, (n, 3).
        damaged: files that are read only up to an entry that no node writes.
    """

    hooks: tuple[tuple[str, str], ...]
    which: Numbers
    starts_ns: Numbers
    ends_ns: Numbers
    credits: Numbers
    damaged: tuple[Path, ...] = ()

    @property
    def is_running(self) -> Numbers:
        """Whether each execution is of another hook than an initialise hook, (executions,)."""
        initialisers = [i for i, (_, kind) in enumerate(self.hooks) if kind == "initialise"]
        found: Numbers = ~np.isin(self.which, initialisers)
        return found


def read_trace(folder: Path) -> Trace:
    """Read the lists of a node; empty where there are none."""
    executions = numbers_of(folder / "executions", np.int64, 3)
    which, starts_ns, ends_ns = executions.T
    good = up_to_first(
        (which < 0) | (which >= _MOST_HOOKS) | (starts_ns < 0) | (ends_ns < starts_ns)
    )
    damaged = () if good == len(executions) else (folder / "executions",)
    executions = executions[:good]
    try:
        hooks = json.loads(read_bytes(folder / "hooks.json"))
        names = [(str(hook["name"]), str(hook["kind"])) for hook in hooks]
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        names = []
    # A node that was killed may have recorded an execution, but not the hook's name.
    count = int(executions[:, 0].max()) + 1 if len(executions) else 0
    names += [(f"hook {place + 1}", "function") for place in range(len(names), count)]
    which, starts_ns, ends_ns = executions.T
    arrivals = numbers_of(folder / "credits", np.int64, 3)
    return Trace(tuple(names), which, starts_ns, ends_ns, arrivals, damaged)


def answers_ns(trace: Trace | None, packets: PacketLists, index: int) -> Numbers:
    """Start on a packet and arrival of its acknowledgement, by their own clocks, (n, 2).

    Acknowledgements are cumulative: each belongs to the last packet that it counts.

    Args:
        trace: of the sender.
        packets, index: of the connection.
    """
    if trace is None or not len(packets.taken):
        return np.empty((0, 2), np.int64)
    credits = trace.credits[trace.credits[:, 0] == index]
    # The last hook that starts on a packet acknowledges it.
    places, lasts = np.unique(packets.taken[::-1], return_index=True)
    taken_ns = packets.taken_ns[::-1][lasts]
    at = np.minimum(np.searchsorted(places, credits[:, 1]), len(places) - 1)
    is_known = places[at] == credits[:, 1]
    found: Numbers = np.column_stack([taken_ns[at], credits[:, 2]])[is_known]
    return found


@dataclass(frozen=True)
class ReviewedRun(PastRun):
    """A run, with the data for pages and figures.

    Attributes:
        missing: a sentence for each missing part.
    """

    missing: tuple[str, ...] = ()

    @property
    def name(self) -> str:
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
        return next((n for n in self.nodes if self.nodes[n].get("sim_time") is not None), None)

    @cached_property
    def time_budgets(self) -> dict[str, TimeBudget]:
        """Time budget of each node that has reported."""
        found = {name: time_budget_of(node, self.running_s) for name, node in self.nodes.items()}
        return {name: spent for name, spent in found.items() if spent is not None}

    @cached_property
    def packets(self) -> dict[str, PacketLists]:
        """The packet lists of every connection."""
        return {name: read_packets(self.folder, end) for name, end in self.ends.items()}

    def flights_ns(self, connection: str) -> Numbers | None:
        """Sending of a packet and start of a hook on it, for each start, (n, 2), if known."""
        may_lose = may_have_lost(self.connections[connection])
        return self.packets[connection].flights_ns(may_lose=may_lose)

    def latencies_ns(self, connection: str) -> Numbers | None:
        """Nanoseconds from the sending of a packet to each start of a hook on it, if known."""
        may_lose = may_have_lost(self.connections[connection])
        return self.packets[connection].latencies_ns(may_lose=may_lose)

    @cached_property
    def traces(self) -> dict[str, Trace]:
        """The first executions of every node that has listed them."""
        found = {name: self.trace(name) for name in self.nodes}
        return {name: trace for name, trace in found.items() if len(trace.starts_ns)}

    def trace(self, node: str) -> Trace:
        """The recorded first executions of a node."""
        return read_trace(self.folder / node / FOLDER)


def open_for_review(folder: Path) -> ReviewedRun:
    """Read a run folder, also an incomplete one.

    Raises:
        UsageError: the folder is of no run, the run goes on, or another version wrote it.
        EnvironmentFault: a file is damaged.
    """
    if (folder / RUN_FILE).exists():
        record, missing = read_run_file(folder), list[str]()
    else:
        record, missing = _from_project(folder)
    run = ReviewedRun(folder, record)
    return replace(run, missing=(*missing, *_missing_lists(run)))


def _from_project(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """A record from the files that exist before the end of a run, and what it lacks."""
    if not (folder / "project.json").is_file():
        raise UsageError(f"{folder} has no run.json: it is not the folder of a run")
    project = read_object(folder / "project.json")
    try:
        connections = [
            {
                "connection": "{source_node}.{source_output} -> {destination_node}"
                ".{destination_input}".format_map(each),
                "index": index,
                "discard_limit": each.get("discard_limit"),
                "queue_size": each.get("queue_size", 1),
                "sent": None,
                "received": None,
                "consumed": None,
            }
            for index, each in enumerate(project.get("connections", ()))
        ]
        nodes = {str(node["name"]): {"report": None} for node in project.get("nodes", ())}
    except (AttributeError, KeyError, TypeError) as error:
        text = f"{folder / 'project.json'} is broken: it is not a project"
        raise EnvironmentFault(text) from error
    record = {
        "project": folder.parent.name if folder.parent.parent.name == "runs" else folder.name,
        "reason": "the run goes on, or its launcher was killed",
        "connections": connections,
        "nodes": nodes,
        "expanded_project": project,
    }
    check_record(record, folder / "project.json")
    for figures in connections:
        packets = read_packets(folder, connection_of(figures))
        figures["sent"] = packets.sent_before + len(packets.sent_ns)
        figures["received"] = packets.received_before + len(packets.received)
        if not packets.taken_before:  # else several hooks may share an unlisted packet
            figures["consumed"] = len({*packets.taken.tolist()})
        figures |= packet_figures(packets, may_lose=may_have_lost(figures))
    return record, [
        "run.json: the run goes on, or its launcher was killed. Packets are counted from the"
        " nodes' lists (up to a second before the end); how nodes spent their time, losses and"
        " ticks are not known, so neither is the bottleneck"
    ]


def _missing_lists(run: ReviewedRun) -> list[str]:
    missing: list[str] = []
    silent = [name for name, node in run.nodes.items() if not node.get("accounting")]
    if silent and len(silent) < len(run.nodes):
        missing.append(f"what {', '.join(silent)} did with its time: it never reported")
    if not (run.folder / FILE_NAME).is_file():
        missing.append("processor and memory: the run was made without -m")
    read_load(run.folder / FILE_NAME, missing.append)
    if (run.record.get("options") or {}).get("packet_log") == "0":
        missing.append("times of single packets: the run was made with --packet-log 0")
    elif not any(len(packets.sent_ns) for packets in run.packets.values()) and run.connections:
        missing.append("times of single packets: no node has listed any")
    missing += [
        f"times and digests of the first {each.before} packets of {name}: they are not kept"
        " (--packet-log)"
        for name, each in run.packets.items()
        if each.before
    ]
    if not run.traces and run.nodes:
        missing.append("the first executions of hooks: no node has listed any")
    damaged = [file for packets in run.packets.values() for file in packets.damaged]
    damaged += [file for name in run.nodes for file in run.trace(name).damaged]
    missing += [f"the rest of {file}: the file is damaged" for file in damaged]
    return missing


def read_load(
    file: Path, complain: Callable[[str], object] = lambda _: None
) -> dict[str, list[float]]:
    """The columns of ``system_load.csv``, NaN where a cell is empty; none if there is no file.

    Rows with a cell that is not a number are left out, as the last row of a run that was cut off.

    Args:
        complain: called with a sentence about damage; the columns end there.
    """
    rows: list[list[str]] = []
    try:
        text = read_bytes(file).decode("utf-8", "replace")
        rows.extend(csv.reader(io.StringIO(text, newline="")))
    except FileNotFoundError:
        return {}
    except (OSError, csv.Error):
        complain(f"the rest of {file}: the file is damaged")
    header = rows.pop(0) if rows else []
    series: dict[str, list[float]] = {name: [] for name in header}
    memory = {name.replace(".cpu_percent", ".memory_bytes") for name in header}
    if len(series) < len(header) or not memory <= {*header}:
        complain(f"the figures in {file}: the file is damaged")
        return {}
    for row in rows:
        try:
            numbers = [float(cell) if cell else float("nan") for cell in row]
        except ValueError:
            continue
        if len(numbers) == len(header) and not any(abs(each) > _MOST for each in numbers):
            for name, number in zip(header, numbers, strict=True):
                series[name].append(number)
    return series
