"""What a project costs that has nothing to do: processor time of all its processes.

Launcher, guardian and nodes, in user space and in the kernel, as a share of one core. The three
kinds run at the same time: each process's own time is counted, and they hardly use any.
"""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.graphs import STRING, lossless
from benchmarks.launching import project_of_plugins
from benchmarks.live import Live, live
from benchmarks.measure import Case, Figure, Group, Subject

NODES = 3
SETTLE_S = 3.0
NEVER_S = 3600.0
"""A tick after this time keeps the project from ending as a deadlock: something may happen yet."""
KINDS = {"process": ("process", NEVER_S), "in process": ("in-process", NEVER_S)}
TICKING = {"process, 1 tick/s": ("process", 1.0), "in process, 1 tick/s": ("in-process", 1.0)}


def subject(is_quick: bool) -> Subject:
    """Ten seconds at a time."""
    seconds = 1.0 if is_quick else 10.0
    cases = [
        Case(
            f"idle project of {NODES} nodes, {label}, share of a core",
            "",
            Figure("side by side", label),
            bound="idle" if label == "process" else None,
        )
        for label in (*KINDS, *TICKING)
    ]
    candidates = {"side by side": functools.partial(idle_shares, seconds)}
    return Subject(
        "processor time of a project without packets", (Group(candidates, tuple(cases)),)
    )


def idle_shares(seconds: float) -> dict[str, float]:
    """Shares of a core that the projects of each kind use."""
    with contextlib.ExitStack() as stack:
        runs = {
            label: stack.enter_context(_project(backend, tick_s))
            for label, (backend, tick_s) in {**KINDS, **TICKING}.items()
        }
        names = [f"node{number}" for number in range(NODES)]
        for run in runs.values():
            run.wait_for(names, "started")
        time.sleep(SETTLE_S)
        start_s = time.monotonic()
        before = {label: _times_s(run) for label, run in runs.items()}
        time.sleep(seconds)
        after = {label: _times_s(run) for label, run in runs.items()}
        passed_s = time.monotonic() - start_s
        for run in runs.values():
            run.check()
    return {label: _used_s(before[label], after[label]) / passed_s for label in runs}


def _used_s(before: Mapping[int, float], after: Mapping[int, float]) -> float:
    return sum(time_s - before.get(thread, 0.0) for thread, time_s in after.items())


def _times_s(run: Live) -> dict[int, float]:
    """Processor time so far of each thread of the run.

    From ``schedstat`` (Linux, ``sched-stats.rst``), in nanoseconds: the times of ``stat`` are
    rounded to 10 ms each, as much as a process may use here in a second.
    """
    times_s = {}
    for process in run.processes():
        for thread in Path(f"/proc/{process.pid}/task").glob("*"):
            with contextlib.suppress(OSError):  # it has just ended
                on_cpu_ns = int((thread / "schedstat").read_text().split()[0])
                times_s[int(thread.name)] = on_cpu_ns / 1e9
    return times_s


@contextlib.contextmanager
def _project(backend: str, tick_s: float) -> Any:
    names = [f"node{number}" for number in range(NODES)]
    project = {
        "nodes": [_node(name, tick_s) for name in names],
        "connections": [
            lossless(f"{source}.out", f"{destination}.in_")
            for source, destination in zip(names, [*names[1:], names[0]], strict=True)
        ],
    }
    with project_of_plugins(project) as folder, live(folder, backend) as run:
        yield run


def _node(name: str, tick_s: float) -> dict[str, Any]:
    return {
        "name": name,
        "container": "neuros_python",
        "plugin": "waiting.py",
        "inputs": [{"name": "in_", "type": STRING}],
        "outputs": [{"name": "out", "type": STRING}],
        "environment": {"TICK_S": str(tick_s)},
    }
