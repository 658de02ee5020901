"""Repeated measurements side by side, and what may be said about them.

Machines differ, and one machine differs from minute to minute. So nothing is measured alone: each
*round* measures all candidates one after the other, every other round in the opposite order, and
two candidates are compared round by round. What is reported is the median of those ratios.
"""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

Measurement = Callable[[], float]


@dataclass(frozen=True)
class Target:
    """A bound for a figure, or for its ratio to another: at most or at least ``bound``."""

    bound: float
    is_maximum: bool = True

    def is_met(self, value: float) -> bool:
        """Whether ``value`` keeps within the bound."""
        return value <= self.bound if self.is_maximum else value >= self.bound

    def __str__(self) -> str:
        return f"{'<=' if self.is_maximum else '>='} {self.bound:g}"


@dataclass(frozen=True)
class Row:
    """One line of the table: what was measured in each round, and against what.

    Attributes:
        unit: of ``values``.
        reference: name and values of what it is compared with, round by round.
        target: for the ratio to the reference, or for the figure itself where there is none.
    """

    name: str
    unit: str
    values: tuple[float, ...]
    reference: tuple[str, tuple[float, ...]] | None = None
    target: Target | None = None

    @property
    def ratios(self) -> tuple[float, ...]:
        """Value over reference of each round; empty without a reference."""
        if self.reference is None:
            return ()
        return tuple(a / b for a, b in zip(self.values, self.reference[1], strict=True))

    @property
    def is_met(self) -> bool | None:
        """Whether the median keeps to the target, ``None`` without one."""
        if self.target is None:
            return None
        return self.target.is_met(statistics.median(self.ratios or self.values))

    def as_json(self) -> dict[str, Any]:
        """Plain data, with every single value."""
        reference = self.reference and {"name": self.reference[0], "values": self.reference[1]}
        return {
            "name": self.name,
            "unit": self.unit,
            "values": self.values,
            "median": statistics.median(self.values),
            "reference": reference,
            "ratio": statistics.median(self.ratios) if self.reference else None,
            "target": None if self.target is None else str(self.target),
            "is_met": self.is_met,
        }

    def as_cells(self) -> list[str]:
        """The cells of the table, see :data:`HEADERS`."""
        against = "" if self.reference is None else self.reference[0]
        met = {True: "yes", False: "NO", None: ""}[self.is_met]
        return [
            self.name,
            f"{_with_range(self.values)} {self.unit}",
            against,
            _with_range(self.ratios) if self.ratios else "",
            "" if self.target is None else str(self.target),
            met,
        ]


HEADERS = ["measurement", "median (range)", "against", "ratio (range)", "target", "met"]


def in_rounds(
    candidates: Mapping[str, Measurement], rounds: int, say: Callable[[str], None]
) -> dict[str, tuple[float, ...]]:
    """Measure all candidates in each round, A B C, C B A, A B C, ...

    Returns:
        The values of each candidate, one per round.
    """
    values: dict[str, list[float]] = {name: [] for name in candidates}
    for number in range(rounds):
        names = list(candidates)
        for name in reversed(names) if number % 2 else names:
            value = candidates[name]()
            values[name].append(value)
            say(f"  {number + 1}/{rounds} {name}: {value:.4g}")
    return {name: tuple(each) for name, each in values.items()}


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "system": platform.platform(),
        "python": platform.python_version(),
        "packages": dict(_versions(("ros-jazzy-rclpy", "mujoco", "nest-simulator"))),
    }


def load_before(seconds: float = 1.0) -> float:
    """Share of all cores that others keep busy now, by watching them for a while."""
    first = _cpu_times()
    time.sleep(seconds)
    busy, total = (now - then for now, then in zip(_cpu_times(), first, strict=True))
    return busy / total if total else 0.0


def _cpu_times() -> tuple[int, int]:
    """Busy and total time of all cores since the start of the machine (``proc_stat(5)``)."""
    fields = Path("/proc/stat").read_text().splitlines()[0].split()[1:9]
    times = [int(field) for field in fields]
    idle = times[3] + times[4]  # idle and iowait; stolen time counts as busy
    return sum(times) - idle, sum(times)


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _versions(names: Iterable[str]) -> Iterable[tuple[str, str]]:
    for name in names:
        try:
            yield name, metadata.version(name)
        except metadata.PackageNotFoundError:
            yield name, "not installed"


def _with_range(values: Iterable[float]) -> str:
    values = sorted(values)
    return f"{statistics.median(values):.3g} ({values[0]:.3g} to {values[-1]:.3g})"
