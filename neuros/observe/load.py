"""What a run takes of its machine: processor, memory and threads of its processes, by node.

Which processes are a node's is told by the environment that they were started with, which their
own children inherit, wherever they run: in a process, in a container (its processes are visible on
the host), behind a double fork. A child that was started without it counts to its parent's group.
Each process of the machine is looked at when it is new; after that, only those of the run are.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import psutil

LAUNCHER = "launcher"
"""The group of the launcher itself, its reaper, and whatever else it starts."""

# A process that is just being started has still the environment of who starts it.
_LOOKS = 3

Owner = Callable[[Mapping[str, str]], str | None]
"""From the environment of a process to its group, ``None`` if it does not belong to the run."""


@dataclass(frozen=True)
class GroupLoad:
    """What the processes of one node take now.

    Attributes:
        cpu_s: processor time since they exist, that of children that have ended included.
        memory_bytes: resident memory; what processes share counts in each of them.
    """

    cpu_s: float
    memory_bytes: int
    threads: int


@dataclass(frozen=True)
class MachineLoad:
    """What the whole machine does now.

    Attributes:
        core_percent: by core, since the last time.
        network_sent_bytes, network_received_bytes: of all interfaces together, the loopback too,
            since the machine was started.
    """

    core_percent: tuple[float, ...]
    memory_used_bytes: int
    memory_percent: float
    network_sent_bytes: int
    network_received_bytes: int


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
