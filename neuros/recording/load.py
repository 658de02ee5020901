"""Load of a run by node: processor, memory and threads, for its record and for the dashboard.

Which processes are a node's is told by the environment that they were started with, which their
own children inherit, wherever they run: in a process, in a container (its processes are visible on
the host), behind a double fork. A child that was started without it counts to its parent's group.
Each process of the machine is looked at when it is new; after that, only those of the run are.
"""

from __future__ import annotations

import csv
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import psutil

from neuros.recording.load_table import FILE_NAME, GroupLoad, LoadTable, MachineLoad

LAUNCHER = "launcher"
"""The group of the launcher itself, its reaper, and all else that it starts."""

PERIOD_S = 1.0

# A process that is just being started has still the environment of who starts it.
_LOOKS = 3

Owner = Callable[[Mapping[str, str]], str | None]
"""From the environment of a process to its group, ``None`` if it does not belong to the run."""


class LoadMeter:
    """Reads the load of a machine, and of the groups of processes of one run."""

    def __init__(self, owner: Owner) -> None:
        self._owner = owner
        self._members: dict[int, tuple[psutil.Process, str]] = {}
        self._looks: dict[int, int] = {}
        self._launcher = psutil.Process()
        psutil.cpu_percent(percpu=True)  # it counts from here

    def machine(self) -> MachineLoad:
        """The load of the machine since this was last asked."""
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
        members = self._find()
        found: dict[str, list[GroupLoad]] = {}
        for process, group in members:
            load = _load_of(process)
            if load is not None:
                found.setdefault(group, []).append(load)
        # The launcher collects the nodes' processes: their time must not appear as its own.
        times = self._launcher.cpu_times()
        own = _load_of(self._launcher, cpu_s=times.user + times.system)
        if own is not None:
            found.setdefault(LAUNCHER, []).append(own)
        return {group: _sum(loads) for group, loads in found.items()}

    def _find(self) -> Sequence[tuple[psutil.Process, str]]:
        """The processes of the run, and their groups."""
        pids = set(psutil.pids())
        for pid in [pid for pid in self._members if pid not in pids]:
            del self._members[pid]
        self._looks = {pid: looks for pid, looks in self._looks.items() if pid in pids}
        adopted: dict[int, tuple[psutil.Process, str]] = {}
        for pid in sorted(pids):
            if pid == os.getpid() or pid in self._members or self._looks.get(pid, 0) >= _LOOKS:
                continue
            try:
                self._look_at(psutil.Process(pid), adopted)
            except psutil.Error:  # gone, or another user's
                self._looks[pid] = self._looks.get(pid, 0) + 1
        return [*self._members.values(), *adopted.values()]

    def _look_at(
        self, process: psutil.Process, adopted: dict[int, tuple[psutil.Process, str]]
    ) -> None:
        parent = process.ppid()
        known = self._members.get(parent) or adopted.get(parent)
        try:
            group = self._owner(process.environ())
        except psutil.Error:
            group = None
        if group is not None:
            self._members[process.pid] = (process, group)
        elif known is not None:
            adopted[process.pid] = (process, known[1])
        elif parent == os.getpid():
            adopted[process.pid] = (process, LAUNCHER)
        else:
            self._looks[process.pid] = self._looks.get(process.pid, 0) + 1


def _load_of(process: psutil.Process, cpu_s: float | None = None) -> GroupLoad | None:
    try:
        with process.oneshot():
            if cpu_s is None:
                cpu_s = sum(process.cpu_times()[:4])  # own and children's, user and system
            memory_bytes, threads = process.memory_info().rss, process.num_threads()
    except psutil.Error:
        return None
    # One that is about to end, or that nobody has waited for yet, has given its memory back.
    return GroupLoad(cpu_s, memory_bytes, threads) if memory_bytes else None


def _sum(loads: Sequence[GroupLoad]) -> GroupLoad:
    return GroupLoad(
        sum(load.cpu_s for load in loads),
        sum(load.memory_bytes for load in loads),
        sum(load.threads for load in loads),
    )


class Meter(Protocol):
    """Source of readings, as :class:`LoadMeter`."""

    def machine(self) -> MachineLoad: ...
    def groups(self) -> Mapping[str, GroupLoad]: ...


class LoadNow:
    """Load since the last call.

    Args:
        clock: monotonic, seconds.
    """

    def __init__(self, meter: Meter, clock: Callable[[], float] = time.monotonic) -> None:
        self._meter = meter
        self._clock = clock
        self._before: dict[str, float] = {}
        self._before_s = clock()

    def __call__(self) -> dict[str, Any]:
        """Percent of a core, bytes and threads, of the machine and by group; JSON-serialisable."""
        machine, groups, now_s = self._meter.machine(), self._meter.groups(), self._clock()
        passed_s = max(now_s - self._before_s, 1e-6)
        shown = {
            name: {
                "cpu_percent": 100.0
                * max(0.0, load.cpu_s - self._before.get(name, load.cpu_s))
                / passed_s,
                "memory_bytes": load.memory_bytes,
                "threads": load.threads,
            }
            for name, load in groups.items()
        }
        self._before, self._before_s = {n: g.cpu_s for n, g in groups.items()}, now_s
        return {
            "cores": list(machine.core_percent),
            "memory_percent": machine.memory_percent,
            "memory_used_bytes": machine.memory_used_bytes,
            "groups": shown,
        }


class LoadMonitor(threading.Thread):
    """Writes ``system_load.csv`` in a run folder until :meth:`stop`.

    Attributes:
        failure: why nothing more is written, ``None`` while all is well.
    """

    def __init__(
        self, folder: Path, meter: Meter, table: LoadTable, period_s: float = PERIOD_S
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
            with open(self._path, "w", newline="", encoding="utf-8") as file:
                self._write(csv.writer(file), file.flush)
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

    def _write(self, writer: Any, flush: Callable[[], None]) -> None:
        writer.writerow(self._table.header)
        flush()
        start_s = time.monotonic()
        self._table.begin(start_s, self._meter.machine(), self._meter.groups())
        due_s = start_s + self._period_s
        while not self._ended.wait(max(0.0, due_s - time.monotonic())):
            now_s = time.monotonic()
            cells = self._table.row(now_s, self._meter.machine(), self._meter.groups())
            writer.writerow([f"{now_s - start_s:.3f}", f"{time.time():.3f}", *cells])
            flush()
            due_s = max(due_s + self._period_s, now_s)
