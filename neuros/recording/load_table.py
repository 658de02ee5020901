"""Rows of ``system_load.csv``: load of the machine and of each node, and their summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

FILE_NAME = "system_load.csv"

_GROUP_COLUMNS = ("cpu_percent", "memory_bytes", "threads")


@dataclass(frozen=True)
class GroupLoad:
    """Load of the processes of one node.

    Attributes:
        cpu_s: processor time since they exist, that of children that have ended included.
        memory_bytes: resident memory; what processes share counts in each of them.
    """

    cpu_s: float
    memory_bytes: int
    threads: int


@dataclass(frozen=True)
class MachineLoad:
    """Load of the whole machine.

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


class LoadTable:
    """Turns readings into rows, and remembers what the summary needs.

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
        """The first reading: processor time and network count from here."""
        self._last = (time_s, machine, groups)

    def row(
        self, time_s: float, machine: MachineLoad, groups: Mapping[str, GroupLoad]
    ) -> list[str]:
        """The cells after the two times; empty ones for a group without a process."""
        assert self._last is not None
        last_s, before, groups_before = self._last
        self._last = (time_s, machine, groups)
        self._machine.note(sum(machine.core_percent), machine.memory_used_bytes)
        cells = [f"{percent:.1f}" for percent in machine.core_percent[: self._cores]]
        cells += [""] * (self._cores - len(cells))  # a core that has been taken offline
        cells += [
            str(machine.memory_used_bytes),
            f"{machine.memory_percent:.1f}",
            str(max(0, machine.network_sent_bytes - before.network_sent_bytes)),
            str(max(0, machine.network_received_bytes - before.network_received_bytes)),
        ]
        for name in self._groups:
            load = groups.get(name)
            if load is None:
                cells += [""] * len(_GROUP_COLUMNS)
                continue
            spent_s = load.cpu_s - (groups_before[name].cpu_s if name in groups_before else 0.0)
            percent = max(0.0, 100 * spent_s / max(time_s - last_s, 1e-9))
            self._figures[name].note(percent, load.memory_bytes, load.threads)
            cells += [f"{percent:.1f}", str(load.memory_bytes), str(load.threads)]
        return cells

    def summary(self) -> dict[str, Any]:
        """Means and maxima, ready for JSON; a group that was never seen has ``None``."""
        machine = None
        if self._machine.count:
            machine = {
                "cores": self._cores,
                **self._machine.cpu(),
                "memory_used_bytes_max": self._machine.memory_bytes,
            }
        return {
            "file": FILE_NAME,
            "samples": self._machine.count,
            "machine": machine,
            "processes": {name: _summary(found) for name, found in self._figures.items()},
        }


@dataclass
class _Extremes:
    """Sums and maxima of any number of readings."""

    count: int = 0
    percent_sum: float = 0.0
    percent: float = 0.0
    memory_bytes: int = 0
    threads: int = 0

    def note(self, percent: float, memory_bytes: int, threads: int = 0) -> None:
        self.count += 1
        self.percent_sum += percent
        self.percent = max(self.percent, percent)
        self.memory_bytes = max(self.memory_bytes, memory_bytes)
        self.threads = max(self.threads, threads)

    def cpu(self) -> dict[str, float]:
        return {"cpu_percent_mean": self.percent_sum / self.count, "cpu_percent_max": self.percent}


def _summary(found: _Extremes) -> dict[str, float] | None:
    if not found.count:
        return None
    return {
        **found.cpu(),
        "memory_bytes_max": found.memory_bytes,
        "threads_max": found.threads,
    }


def load_table(summary: Mapping[str, Any]) -> str:
    """The summary as text; one line where there is nothing to sum up."""
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
