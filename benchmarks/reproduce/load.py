"""What ``system_load.csv`` says about a part of a run."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from statistics import fmean

from neuros.recording.system_load import FILE_NAME

LAUNCHER = "launcher"
_CPU, _MEMORY = ".cpu_percent", ".memory_bytes"


def load_between(run_folder: Path, begin_s: float, end_s: float) -> dict[str, float]:
    """Means over the rows that lie between two moments (Unix time); empty without such a row.

    Returns:
        ``cpu_machine_percent`` (100: all cores), ``cpu_nodes_percent`` (the same scale),
        ``cpu_percent.<node>`` (again), ``memory_machine_MB``, ``memory_nodes_MB``,
        ``memory_MB.<node>``, and ``load_samples``.
    """
    rows = _rows_between(run_folder / FILE_NAME, begin_s, end_s)
    if not rows:
        return {}
    cores = [key for key in rows[0] if key.startswith("core") and key.endswith("_percent")]
    cpu = {name: _mean(rows, name + _CPU) / len(cores) for name in _groups(rows[0])}
    memory = {name: _mean(rows, name + _MEMORY) / 1e6 for name in cpu}
    return {
        "load_samples": float(len(rows)),
        "cpu_machine_percent": sum(_mean(rows, core) for core in cores) / len(cores),
        "cpu_nodes_percent": sum(cpu.values()),
        "memory_machine_MB": _mean(rows, "memory_used_bytes") / 1e6,
        "memory_nodes_MB": sum(memory.values()),
        **{f"cpu_percent.{name}": value for name, value in cpu.items()},
        **{f"memory_MB.{name}": value for name, value in memory.items()},
    }


def _rows_between(file: Path, begin_s: float, end_s: float) -> list[dict[str, str]]:
    """A row is about the time since the one before it."""
    with file.open(newline="", encoding="utf-8") as stream:
        every = list(csv.DictReader(stream))
    times = [float(row["unix_time_s"]) for row in every]
    befores = [times[0] - float(every[0]["time_s"]), *times] if every else []
    return [
        row
        for row, before, time_s in zip(every, befores, times, strict=False)
        if before >= begin_s and time_s <= end_s
    ]


def _groups(row: Mapping[str, str]) -> list[str]:
    """The nodes, or what stands for all of them where they share a process."""
    names = [key.removesuffix(_CPU) for key in row if key.endswith(_CPU)]
    return [name for name in names if name != LAUNCHER]


def _mean(rows: list[dict[str, str]], key: str) -> float:
    """An empty cell stands for a group without a process."""
    return fmean(float(row[key] or 0) for row in rows)
