"""System load of a run: processor, memory and threads of the machine and of each node.

The environment of a process tells its node. Children inherit it wherever they run: in a process, in
a container (its processes are visible on the host), behind a double fork. A child that was started
without it counts to its parent's group. Each process of the machine is read when it is new, and
later only if it belongs to the run.
"""

from __future__ import annotations

import csv
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from neuros.ordinary_files import open_new

FILE_NAME = "system_load.csv"

LAUNCHER = "launcher"
"""The group of the launcher, its guardian, and other programs that it starts."""

PERIOD_S = 1.0

# A process that has just been forked still has the environment of its parent.
_TRIES = 3

Owner = Callable[[Mapping[str, str]], str | None]
"""From the environment of a process to its group, ``None`` if it does not belong to the run."""

_Member = tuple[psutil.Process, str]
"""A process of the run, and its group."""

_GROUP_COLUMNS = ("cpu_percent", "memory_bytes", "threads")


class GroupLoad(NamedTuple):
    """Load of the processes of one node.

    Attributes:
        cpu_s: processor time since their start, with that of children that have ended.
        memory_bytes: resident memory; shared memory counts in each process.
    """

    cpu_s: float
    memory_bytes: int
    threads: int


class MachineLoad(NamedTuple):
    """Load of the whole machine.

    Attributes:
        core_percent: by core, since the last reading.
        network_sent_bytes, network_received_bytes: of all interfaces, with the loopback, since the
            machine was started.
    """

    core_percent: tuple[float, ...]
    memory_used_bytes: int
    memory_percent: float
    network_sent_bytes: int
    network_received_bytes: int


class LoadTable:
    """Turns readings into rows and a summary.

    Args:
        groups: the groups of processes, in the order of their columns.
        cores: of this machine.
    """

    def __init__(self, groups: Sequence[str], cores: int) -> None:
        self._groups = tuple(groups)
        self._cores = cores
        self._last: tuple[float, MachineLoad, Mapping[str, GroupLoad]] | None = None
        self._figures = {name: _Extremes() for name in groups}
        self._machine = _Extremes()

    @property
    def header(self) -> list[str]:
        """The names of the columns, with their units. Percent of a node are of one core."""
        return [
            "time_s",
            "unix_time_s",
            *(f"core{core}_percent" for core in range(self._cores)),
            "memory_used_bytes",
            "memory_percent",
            "network_sent_bytes",
            "network_received_bytes",
            *(f"{name}.{column}" for name in self._groups for column in _GROUP_COLUMNS),
        ]

    def begin(self, time_s: float, machine: MachineLoad, groups: Mapping[str, GroupLoad]) -> None:
        """Set the reading that processor time and network count from."""
        self._last = (time_s, machine, groups)

    def row(
        self, time_s: float, machine: MachineLoad, groups: Mapping[str, GroupLoad]
    ) -> list[str]:
        """The cells after the two times; empty ones for a group without a process."""
        assert self._last is not None
        last_s, before, groups_before = self._last
        self._last = (time_s, machine, groups)
        self._machine.add(sum(machine.core_percent), machine.memory_used_bytes)
        cells = [f"{percent:.1f}" for percent in machine.core_percent[: self._cores]]
        cells += [""] * (self._cores - len(cells))  # cores that have been switched off
        cells += [
            str(machine.memory_used_bytes),
            f"{machine.memory_percent:.1f}",
            str(max(0, machine.network_sent_bytes - before.network_sent_bytes)),
            str(max(0, machine.network_received_bytes - before.network_received_bytes)),
        ]
        for name in self._groups:
            load, load_before = groups.get(name), groups_before.get(name)
            if load is None:
                cells += [""] * len(_GROUP_COLUMNS)
                continue
            spent_s = load.cpu_s - (load_before.cpu_s if load_before else 0.0)
            percent = max(0.0, 100 * spent_s / max(time_s - last_s, 1e-9))
            self._figures[name].add(percent, load.memory_bytes, load.threads)
            cells += [f"{percent:.1f}", str(load.memory_bytes), str(load.threads)]
        return cells

    def summary(self) -> dict[str, Any]:
        """Means and maxima, ready for JSON; ``None`` for a group that never had a process."""
        machine = self._machine.summary("memory_used_bytes_max")
        processes = {name: x.summary("memory_bytes_max") for name, x in self._figures.items()}
        for name, load in processes.items():
            if load is not None:
                load["threads_max"] = self._figures[name].threads
        return {
            "file": FILE_NAME,
            "samples": self._machine.count,
            "machine": machine and {"cores": self._cores, **machine},
            "processes": processes,
        }


@dataclass
class _Extremes:
    """Sums and maxima of any number of readings."""

    count: int = 0
    percent_sum: float = 0.0
    percent: float = 0.0
    memory_bytes: int = 0
    threads: int = 0

    def add(self, percent: float, memory_bytes: int, threads: int = 0) -> None:
        self.count += 1
        self.percent_sum += percent
        self.percent = max(self.percent, percent)
        self.memory_bytes = max(self.memory_bytes, memory_bytes)
        self.threads = max(self.threads, threads)

    def summary(self, memory: str) -> dict[str, float] | None:
        """``None`` without a reading; ``memory`` is the key of the largest memory."""
        if not self.count:
            return None
        return {
            "cpu_percent_mean": self.percent_sum / self.count,
            "cpu_percent_max": self.percent,
            memory: self.memory_bytes,
        }


def load_table(summary: Mapping[str, Any]) -> str:
    """The summary as text; one line for a run without a sample."""
    from tabulate import tabulate

    machine = summary["machine"]
    if machine is None:
        return "system load: the run was shorter than the first sample"
    rows = [
        [name, *_cells(load, "memory_bytes_max"), f"{load['threads_max']:.0f}"]
        for name, load in summary["processes"].items()
        if load is not None
    ]
    rows.append(["(whole machine)", *_cells(machine, "memory_used_bytes_max"), ""])
    table = tabulate(
        rows,
        headers=["system load", "cpu mean", "cpu max", "memory max", "threads max"],
        disable_numparse=True,
        colalign=("left", "right", "right", "right", "right"),
    )
    cores = machine["cores"]
    samples = f"{summary['samples']} sample{'' if summary['samples'] == 1 else 's'}"
    return f"{table}\n100% is one core of {cores}; {samples}: {summary['file']}"


def _cells(load: Mapping[str, float], memory: str) -> list[str]:
    return [
        f"{load['cpu_percent_mean']:.0f}%",
        f"{load['cpu_percent_max']:.0f}%",
        f"{load[memory] / 1e6:.0f} MB",
    ]


class LoadMeter:
    """Reads the load of a machine, and of the groups of processes of one run."""

    def __init__(self, owner: Owner) -> None:
        self._owner = owner
        self._members: dict[int, _Member] = {}
        self._tries: dict[int, int] = {}
        self._launcher = psutil.Process()
        psutil.cpu_percent(percpu=True)  # the first call sets the time to count from

    def machine(self) -> MachineLoad:
        """The load of the machine since the last call."""
        memory, network = psutil.virtual_memory(), psutil.net_io_counters()
        return MachineLoad(
            core_percent=tuple(psutil.cpu_percent(percpu=True)),
            memory_used_bytes=memory.used,
            memory_percent=memory.percent,
            network_sent_bytes=network.bytes_sent if network else 0,
            network_received_bytes=network.bytes_recv if network else 0,
        )

    def groups(self) -> dict[str, GroupLoad]:
        """The load of each group that has a process now; :data:`LAUNCHER` always has."""
        found: dict[str, list[GroupLoad]] = {}
        for process, group in self._find():
            load = _load_of(process, with_children=group != LAUNCHER)
            if load is not None:
                found.setdefault(group, []).append(load)
        # The guardian collects the nodes' processes: their time must not appear as the launcher's.
        own = _load_of(self._launcher, with_children=False)
        if own is not None:
            found.setdefault(LAUNCHER, []).append(own)
        return {
            group: GroupLoad(*map(sum, zip(*loads, strict=True))) for group, loads in found.items()
        }

    def _find(self) -> Sequence[_Member]:
        """The processes of the run, and their groups."""
        pids = set(psutil.pids())
        self._members = {pid: member for pid, member in self._members.items() if pid in pids}
        self._tries = {pid: tries for pid, tries in self._tries.items() if pid in pids}
        adopted: dict[int, _Member] = {}
        for pid in sorted(pids):
            if pid == os.getpid() or pid in self._members or self._tries.get(pid, 0) >= _TRIES:
                continue
            group, parent = None, 0
            try:
                process = psutil.Process(pid)
                parent = process.ppid()
                group = self._owner(process.environ())
            except psutil.Error:  # gone, or another user's
                pass
            known = self._members.get(parent) or adopted.get(parent)
            if group is not None:
                self._members[pid] = (process, group)
            elif known is not None:
                adopted[pid] = (process, known[1])
            elif parent == os.getpid():
                adopted[pid] = (process, LAUNCHER)
            else:
                self._tries[pid] = self._tries.get(pid, 0) + 1
        return [*self._members.values(), *adopted.values()]


def _load_of(process: psutil.Process, *, with_children: bool) -> GroupLoad | None:
    try:
        with process.oneshot():
            # User and system, and then those of children that have ended.
            cpu_s = sum(process.cpu_times()[: 4 if with_children else 2])
            memory_bytes, threads = process.memory_info().rss, process.num_threads()
    except psutil.Error:
        return None
    # A process that is about to end, or has not been waited for, has given its memory back.
    return GroupLoad(cpu_s, memory_bytes, threads) if memory_bytes else None


class LoadMonitor(threading.Thread):
    """Writes ``system_load.csv`` in a run folder until :meth:`stop`.

    Attributes:
        failure: why nothing more is written, ``None`` while all is well.
    """

    def __init__(
        self, folder: Path, meter: LoadMeter, table: LoadTable, period_s: float = PERIOD_S
    ) -> None:
        super().__init__(name="neuros-monitor", daemon=True)
        self._path = folder / FILE_NAME
        self._meter = meter
        self._table = table
        self._period_s = period_s
        self._ended = threading.Event()
        self.failure: str | None = None

    def run(self) -> None:
        """Write rows until the end, or until there is no room for them."""
        try:
            # Line by line, so that it can be read while the run goes on.
            with TextIOWrapper(
                open_new(self._path), "utf-8", newline="", line_buffering=True
            ) as file:
                self._write(csv.writer(file))
        except OSError as error:
            self.failure = (
                f"{self._path} could not be written to ({error.strerror}): the system load was not"
                " recorded to the end"
            )

    def stop(self) -> dict[str, Any]:
        """Write no further row; returns the summary."""
        self._ended.set()
        self.join()
        return self._table.summary()

    def _write(self, writer: Any) -> None:
        writer.writerow(self._table.header)
        start_s = time.monotonic()
        self._table.begin(start_s, self._meter.machine(), self._meter.groups())
        due_s = start_s + self._period_s
        while not self._ended.wait(max(0.0, due_s - time.monotonic())):
            now_s = time.monotonic()
            cells = self._table.row(now_s, self._meter.machine(), self._meter.groups())
            writer.writerow([f"{now_s - start_s:.3f}", f"{time.time():.3f}", *cells])
            due_s = max(due_s + self._period_s, now_s)
