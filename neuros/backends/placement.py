"""Cores of the nodes of a run, and how many threads their numerical libraries start.

A node with ``affinity`` has the cores that it names; the kernel places all others. A rule that gave
each node a core of its own was measured and dropped: ``docs/placement.md`` has the figures.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterator, Mapping, Sequence

from neuros.project.model import Node

Cores = tuple[int, ...]
"""Numbers of cores, ascending."""

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
"""How many threads the usual numerical libraries start."""


def place(nodes: Sequence[Node]) -> Mapping[str, Cores]:
    """The cores of each node with ``affinity``, by name; also those that this machine lacks."""
    return {node.name: tuple(sorted(node.affinity)) for node in nodes if node.affinity}


def thread_limits(nodes: Sequence[Node]) -> dict[str, str]:
    """The environment that keeps numerical libraries to the cores that nodes have asked for.

    Nodes of one process run one at a time: what the widest of them asked for is enough.
    """
    count = max((len(node.affinity) for node in nodes), default=0)
    return dict.fromkeys(THREAD_VARIABLES, str(count)) if count else {}


def on_cores(cores: Cores | None) -> str:
    """The cores of a node in words, empty where the kernel chooses."""
    if not cores:
        return ""
    return f" on core{'s' if len(cores) > 1 else ''} {', '.join(map(str, cores))}"


def usable_cores() -> frozenset[int]:
    """The cores that this process may use: ``taskset`` and control groups are respected."""
    return frozenset(os.sched_getaffinity(0))


@contextlib.contextmanager
def children_on(cores: Collection[int]) -> Iterator[None]:
    """Processes that this thread starts inside get these cores, and so do all their threads.

    The mask is there before the first instruction of the child: scripts, imports and the threads
    of DDS have it, too. Without any nothing changes. Raises ``OSError`` for one that is not there.
    """
    if not cores:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
