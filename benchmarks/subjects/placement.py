"""What a core of its own for each node gains, and what it costs where a machine does other things.

Each candidate is measured as the default places it, left to the kernel (``--no-placement``), and
with a core each (``affinity``), in the same rounds. Situations are what else runs meanwhile.
"""

from __future__ import annotations

import contextlib
import functools
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.launching import RUN_S, launch
from benchmarks.measure import MINIMUM_PAIRS, Case, Figure, Group, Measurement, Subject
from benchmarks.ping_pong import (
    CORE_EACH,
    IMU_PACKET,
    KERNEL,
    UNPINNED,
    neuros,
    options_of,
    placed_project,
)
from benchmarks.processes import two_cores
from benchmarks.subjects.whiskeye import RATE, WHISKEYE

QUIET, OTHER_RUN, SWEEP = "quiet", "another run beside", "two runs at once"
BUSY = {"one busy process": 1, "two busy processes": 2}
SITUATIONS = (QUIET, *BUSY, OTHER_RUN, SWEEP)
PLACES = (UNPINNED, KERNEL, CORE_EACH)
DEFAULT = "default"
SIMULATED_S = 10.0
Figures = Callable[[], Mapping[str, float]]
_SPIN = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: sum(range(10_000))"
_ENDLESS = 10**9


def subject(is_quick: bool) -> Subject:
    """Round trips, or simulated seconds, per run."""
    count = 500 if is_quick else 4000
    simulated_s = SIMULATED_S * (0.1 if is_quick else 1)
    groups = [_round_trip(situation, count) for situation in SITUATIONS]
    groups += [_whiskeye(situation, simulated_s) for situation in (QUIET, *BUSY)]
    return Subject(
        "the default placement, the kernel's, and a core each, under load", tuple(groups)
    )


def _round_trip(situation: str, count: int) -> Group:
    run = functools.partial(neuros, IMU_PACKET, "process", count)
    candidates = {
        _name(place): functools.partial(under, situation, place, functools.partial(run, place))
        for place in PLACES
    }
    return _group(
        f"round trip, IMU, {situation}",
        candidates,
        (("median", "us"), ("p90", "us"), ("p99", "us")),
    )


def _whiskeye(situation: str, simulated_s: float) -> Group:
    candidates = {
        _name(place): functools.partial(
            under, situation, place, functools.partial(strict, place, simulated_s)
        )
        for place in PLACES
    }
    return _group(f"whiskeye strict, {situation}", candidates, ((RATE, ""),))


def _group(
    name: str, candidates: Mapping[str, Measurement], figures: Sequence[tuple[str, str]]
) -> Group:
    cases = [
        Case(
            f"{name}, {figure.replace('_', ' ')}, {candidate}",
            unit,
            Figure(candidate, figure),
            Figure(KERNEL, figure),
            KERNEL,
        )
        for figure, unit in figures
        for candidate in candidates
        if candidate != KERNEL
    ]
    return Group(candidates, tuple(cases), MINIMUM_PAIRS)


def _name(place: str) -> str:
    return DEFAULT if place == UNPINNED else place


def under(situation: str, place: str, measure: Figures) -> Mapping[str, float]:
    """A measurement while something else runs; of two at once, the means."""
    if situation == SWEEP:
        with ThreadPoolExecutor(2) as pool:
            both = [each.result() for each in [pool.submit(measure) for _ in range(2)]]
        return {key: (both[0][key] + both[1][key]) / 2 for key in both[0]}
    beside = another_run(place) if situation == OTHER_RUN else busy(BUSY.get(situation, 0))
    with beside:
        return measure()


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """So many processes that never pause, on any core; they end with the benchmark."""
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            command = [sys.executable, "-S", "-c", _SPIN]
            process = stack.enter_context(subprocess.Popen(command))
            stack.callback(process.kill)
        yield


@contextlib.contextmanager
def another_run(place: str) -> Iterator[None]:
    """Another run of the same project, placed alike, which ends with the block."""
    with placed_project(IMU_PACKET, _ENDLESS, place) as folder:
        command = [sys.executable, "-m", "neuros.cli", "launch", str(folder), *options_of(place)]
        command += ["--backend", "process", "-o", str(folder / "run"), "--duration", f"{RUN_S:g}"]
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        try:
            yield
        finally:
            process.terminate()  # it ends its nodes
            process.wait()


def strict(place: str, simulated_s: float) -> dict[str, float]:
    """WhiskEye's strict orchestration; *a core each* is for robot and network."""
    settings: dict[str, Any] = {"nodes.robot.environment.DURATION": simulated_s}
    if place == CORE_EACH:
        first, second = two_cores()
        settings |= {"nodes.robot.affinity": [first], "nodes.snn.affinity": [second]}
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as folder:
        run = launch(
            WHISKEYE / "strict.json",
            Path(folder) / "run",
            "process",
            settings=settings,
            options=options_of(place),
        )
    return {RATE: float(run[RATE])}
