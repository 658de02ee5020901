"""Short rows of work, not of time, which ``neuros benchmark guard --against COMMIT`` holds.

Instructions and calls are the same in each run. Processor time is not, but differs less than time
does: that of packets is taken within a run, in hundreds, of which the least counts.
"""

from __future__ import annotations

import functools
import json
import resource
import statistics
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any

from benchmarks.launching import launch
from benchmarks.measure import Case, Figure, Group, Measurement, Subject
from benchmarks.ping_pong import LARGE, SMALL, UNPINNED, Packet, placed_project
from benchmarks.subjects.engine import relay_us
from benchmarks.subjects.whiskeye import WHISKEYE

ENGINE, INSIDE, BETWEEN, BIG, LOOP = "engine", "in process", "process", "large", "whiskeye"
_EXECUTIONS = 500
_SIMULATED_S = 5.0


def subject(is_quick: bool) -> Subject:
    """The same rows, quick or not: they are short."""
    candidates: dict[str, Measurement] = {
        ENGINE: instructions,
        INSIDE: functools.partial(packets, SMALL, "in-process", 10_000),
        BETWEEN: functools.partial(packets, SMALL, "process", 3_000),
        BIG: functools.partial(packets, LARGE, "process", 1_000),
        LOOP: whiskeye_s,
    }
    of_a_node = "processor time of a node"
    cases = (
        Case("execution of a hook, engine alone, instructions of Python", "steps", Figure(ENGINE)),
        Case("round trip, 8 B, in process, calls", "calls", Figure(INSIDE, "calls")),
        Case("round trip, 8 B, in process, processor time", "us", Figure(INSIDE, "trip")),
        Case("round trip, 8 B, process, calls in a node", "calls", Figure(BETWEEN, "calls")),
        Case(f"round trip, 8 B, process, {of_a_node}", "us", Figure(BETWEEN, "trip")),
        Case(f"round trip, 921,600 B there, process, {of_a_node}", "us", Figure(BIG, "trip")),
        Case("run of two nodes, process, processor time", "s", Figure(BETWEEN, "run")),
        Case("run of whiskeye, strict, in process, processor time", "s", Figure(LOOP, "run")),
    )
    return Subject("instructions, calls, processor time of short runs", (Group(candidates, cases),))


def instructions() -> float:
    """Instructions of Python for a hook that sends on what arrives, engine alone."""
    counted = 0

    def step(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal counted
        frame.f_trace_opcodes = True
        counted += event == "opcode"
        return step

    before = sys.gettrace()
    sys.settrace(step)
    try:
        relay_us(_EXECUTIONS)
    finally:
        sys.settrace(before)
    return counted / _EXECUTIONS


def packets(packet: Packet, backend: str, count: int) -> dict[str, float]:
    """Of a run: microseconds of the first node's process per ``trip``, its ``calls`` meanwhile.

    ``run`` is the seconds of all processes together.
    """
    with placed_project(packet, count, UNPINNED) as folder:
        seconds = _run_s(folder, folder / "run", backend)
        hundreds_us, calls = (
            json.loads((folder / "run" / "ping" / f"{name}.json").read_text())
            for name in ("worked", "calls")
        )
    return {"trip": min(hundreds_us) / 100, "calls": statistics.median(calls), "run": seconds}


def whiskeye_s() -> dict[str, float]:
    """Seconds of a whole run."""
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as folder:
        settings = {"nodes.robot.environment.DURATION": _SIMULATED_S}
        run = Path(folder) / "run"
        return {"run": _run_s(WHISKEYE / "strict.json", run, "in-process", settings=settings)}


def _run_s(project: Path, run_folder: Path, backend: str, **options: object) -> float:
    """Seconds of processor time from the command to its end, of all its processes together."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    launch(project, run_folder, backend, **options)  # type: ignore[arg-type]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
