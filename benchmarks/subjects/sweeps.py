"""How much sooner a sweep is over with two workers, and what a long one costs its front end."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from pathlib import Path
from typing import Any

import neuros
from benchmarks.measure import Case, Figure, Group, Quotient, Subject
from neuros.distribution import ROOT

ELEVATOR = ROOT / "examples" / "3_physics_simulation" / "elevator"


def subject(is_quick: bool) -> Subject:
    """Sixteen runs of some seconds, and a thousand that take no time."""
    runs, many = (2, 20) if is_quick else (16, 1000)
    workers = {f"{count} at once": partial(seconds, runs, count) for count in (1, 2)}
    one, two = map(Figure, workers)
    speed_up = Case(
        f"sweep of {runs} small runs, speed-up of two workers on one", "", Quotient(one, two)
    )
    cost = Case(f"front end of a sweep of {many} runs, processor time of a run", "ms", Figure("it"))
    return Subject(
        "speed-up of a sweep with two workers, processor time of its front end",
        (
            Group(workers, (speed_up,), rounds=3),
            Group({"it": partial(front_end_ms, many)}, (cost,), rounds=3),
        ),
    )


def seconds(runs: int, jobs: int) -> float:
    """How long a sweep takes, on this machine."""
    with tempfile.TemporaryDirectory() as folder:
        began_s = time.monotonic()
        made = neuros.sweep(
            ELEVATOR,
            repeat=runs,
            jobs=jobs,
            backend="in-process",
            duration="20sim",
            output=Path(folder, "sweep"),
        )
        took_s = time.monotonic() - began_s
    assert all(row["exit_code"] == 0 for row in made.rows), made
    return took_s


def front_end_ms(runs: int) -> float:
    """Processor time of each run, where others make them: checks, jobs and the table."""
    with tempfile.TemporaryDirectory() as folder:
        began_s = time.process_time()
        made = neuros.sweep(
            ELEVATOR, repeat=runs, executor=Elsewhere(), output=Path(folder, "sweep")
        )
        took_s = time.process_time() - began_s
    assert len(made.rows) == runs
    return took_s * 1000 / runs


class Elsewhere(Executor):
    """Answers at once with a row."""

    def submit(self, job: Callable[..., Any], /, *_: Any, **__: Any) -> Future[Any]:
        future: Future[Any] = Future()
        row = {**job.values, "exit_code": 0, "reason": "ended", "wall_s": 1.0}  # type: ignore[attr-defined]
        row |= {f"elevator.figure_{number}": 0.1 * number for number in range(20)}
        future.set_result({**row, "folder": str(job.folder)})  # type: ignore[attr-defined]
        return future
