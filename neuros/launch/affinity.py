"""The cores that processes may use: what this one has, and what its children inherit."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterator


def usable_cores() -> frozenset[int]:
    """The cores that this process may use: ``taskset`` and control groups are respected."""
    return frozenset(os.sched_getaffinity(0))


@contextlib.contextmanager
def children_on(cores: Collection[int] | None) -> Iterator[None]:
    """Processes that this thread starts inside get these cores, and so do all their threads.

    The mask is there before the first instruction of the child: scripts, imports and the threads
    of DDS have it, too. ``None`` changes nothing. Raises ``OSError`` for a core that is not there.
    """
    if cores is None:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
