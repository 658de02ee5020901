"""Runs a load project beside busy processes, and judges what was counted and measured."""

from __future__ import annotations

import contextlib
import functools
import json
import statistics
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from tests.support.launching import LAUNCH, start

from .shapes import SHAPES, Shape

BACKENDS = ("in-process", "process", "docker")
_POLL_S = 0.5
_STARTS_WITHIN_S = 120.0
_MOST_PER_PACKET_S = 0.05
_GROWTH_SHARE, _GROWTH_BYTES = 0.1, 24 << 20  # three of the largest packets that malloc keeps
_SLOWER, _SLOWER_MS = 2.0, 2.0
_FEWEST_SAMPLES = 20
_FEWEST_TENTH = 3  # a shorter run is all beginning
# In a shorter run each process may still come to keep so many: one in 10,000 packets is so large.
_FEWEST_PACKETS = 500_000
_BUSY = "import os; parent = os.getppid()\nwhile os.getppid() == parent: pass"  # ends with it


@dataclass
class Load:
    """What came of a run.

    Attributes:
        lossless: packets that arrived on lossless connections.
        latency_ms: of packets of 8 bytes, from hook to hook: median of the first and of the last
            tenth, and the 99th percentile of all. Whether it grew, a long run tells.
        memory_mb: private memory of all processes: lower quartile of the first tenth, behind the
            first fifth of the run, and of the last one.
        problems: what is not as it must be.
    """

    shape: str
    backend: str
    lossless: int = 0
    seconds: float = 0.0
    latency_ms: tuple[float, float, float] = (0.0, 0.0, 0.0)
    memory_mb: tuple[float, float] = (0.0, 0.0)
    problems: list[str] = field(default_factory=list)


def run(
    name: str, backend: str, packets: int, folder: Path, *, largest: int, busy: int = 2
) -> Load:
    """Run a shape in an empty folder.

    Args:
        packets: on all lossless connections together.
        largest: bytes of the largest packets.
        busy: so many processes compute beside it.
    """
    shape, mark = SHAPES[name](), uuid.uuid4().hex
    count = shape.write(folder, packets, largest, mark)
    load, memory = Load(name, backend), []
    options = (folder / "project.json", "--backend", backend, "-o", "run")
    deadline_s = time.monotonic() + _STARTS_WITHIN_S + packets * _MOST_PER_PACKET_S
    # One that is forked would not show its mark.
    starting = functools.partial(start, cwd=folder, program=LAUNCH, LOAD_MARK=mark)
    with busy_processes(busy), starting(*options) as running:
        while running.process.poll() is None:
            if time.monotonic() > deadline_s:
                load.problems.append("did not end")
                return load
            next_s = time.monotonic() + _POLL_S
            memory.append(_private_bytes(mark))
            while running.process.poll() is None and time.monotonic() < next_s:
                if not running.read(next_s - time.monotonic()):
                    break
        while running.read(_POLL_S):
            pass
        exit_code, output = running.process.returncode, running.output
    try:
        record = json.loads((folder / "run" / "run.json").read_text())
    except (OSError, ValueError) as error:
        load.problems.append(f"no run.json: {error}: {output[-1000:]}")
        return load
    if exit_code:
        load.problems.append(f"exit code {exit_code}: {record['reason']}: {output[-3000:]}")
        return load
    load.seconds = record["wall_s"]
    told = {
        node: json.loads((folder / "run" / node / "told.json").read_text())
        for node in shape.plugins
    }
    load.problems += count_problems(shape, count, told, record["connections"])
    load.lossless = sum(
        _seen(told, source, destination)["count"]
        for source, destination, limit, _ in shape.ends
        if limit == 0
    )
    load.latency_ms = latency([each["ages_ms"] for each in told.values() if "ages_ms" in each])
    judge_memory(load, while_all_live(memory), processes=len(shape.plugins))
    return load


@contextlib.contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """So many processes that compute all the time, while the block lasts."""
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            process = subprocess.Popen([sys.executable, "-S", "-c", _BUSY])
            stack.callback(process.wait)
            stack.callback(process.kill)
        yield


def _private_bytes(mark: str) -> tuple[int, int]:
    """How many processes a run has, with the launcher, and the memory they share with none."""
    count = total = 0
    for process in psutil.process_iter():
        # One may end, or another may be of a user who cannot be looked at.
        with contextlib.suppress(psutil.Error, OSError):
            if process.environ().get("LOAD_MARK") == mark:
                total += process.memory_full_info().uss
                count += 1
    return count, total


def while_all_live(samples: Sequence[tuple[int, int]]) -> list[int]:
    """The memory at the moments with as many processes as at most moments.

    Containers start, and are removed, over many seconds on a busy machine.
    """
    usual = statistics.mode(count for count, _ in samples) if samples else 0
    return [total for count, total in samples if count == usual]


def _seen(told: Mapping[str, Any], source: str, destination: str) -> Mapping[str, Any]:
    nothing = {"count": 0, "chain": 0, "skipped": 0, "last": 0}
    found: Mapping[str, Any] = told[destination]["sources"].get(source, nothing)
    return found


def count_problems(
    shape: Shape, count: int, told: Mapping[str, Any], counters: Sequence[Mapping[str, Any]]
) -> Iterator[str]:
    """What was lost, or arrived as something else."""
    by_name = {each["connection"]: each for each in counters}
    for source, destination, limit, _ in shape.ends:
        name, seen = f"{source}.o -> {destination}.x", _seen(told, source, destination)
        if limit is not None and seen["skipped"] > limit:
            yield f"{name}: {seen['skipped']} lost in a row, limit {limit}"
        if limit == 0:
            if seen["count"] < count:
                yield f"{name}: {seen['count']} of {count} packets"
            if seen["chain"] != told[source]["sent"]["chain"]:
                yield f"{name}: the hashes of what was received are not those of what was sent"
            if by_name[name]["lost"]:
                yield f"{name}: {by_name[name]['lost']} lost"


def latency(ages_ms: Sequence[Sequence[float]]) -> tuple[float, float, float]:
    """Median of the first and of the last tenth, and 99th percentile, of all that was measured."""
    tenths = [(each[: len(each) // 10], each[-(len(each) // 10) :]) for each in ages_ms]
    first = [age for begin, _ in tenths for age in begin]
    last = [age for _, end in tenths for age in end]
    if len(first) < _FEWEST_SAMPLES:
        return (0.0, 0.0, 0.0)
    every = sorted(age for each in ages_ms for age in each)
    return (statistics.median(first), statistics.median(last), every[int(0.99 * len(every))])


def latency_problems(latency_ms: tuple[float, float, float]) -> Iterator[str]:
    """Whether it grew; a run of some seconds shows just what else the machine did."""
    before_ms, after_ms, _ = latency_ms
    if after_ms > _SLOWER * before_ms + _SLOWER_MS:
        yield f"latency grew from {before_ms:.2f} to {after_ms:.2f} ms"


def judge_memory(load: Load, samples: Sequence[int], processes: int) -> None:
    """Note the memory, and whether it grew."""
    # Memory grows to its size with a sender's second packet of the largest size, by one step. Of a
    # million packets it comes in the first fifth.
    begun = samples[len(samples) // 5 :]
    tenth = len(begun) // 10
    if tenth < _FEWEST_TENTH:
        return
    # Not the median: large packets that wait for each other at an `All` input come and go.
    before, after = (
        statistics.quantiles(each, n=4)[0] for each in (begun[:tenth], begun[-1 - tenth : -1])
    )
    load.memory_mb = (before / 1e6, after / 1e6)
    keeping = 1 if load.lossless >= _FEWEST_PACKETS else processes
    if after > before * (1 + _GROWTH_SHARE) + keeping * _GROWTH_BYTES:
        load.problems.append(f"memory grew from {before / 1e6:.0f} to {after / 1e6:.0f} MB")
