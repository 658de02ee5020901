"""What tests of endings share: a node that runs until it is ended, and what may be left of it."""

from __future__ import annotations

import contextlib
import fcntl
from pathlib import Path

from neuros.backends.shared_memory import _are_held

GONE_WITHIN_S = 6.0
RUNS = """
@neuros_tick(seconds=0.05)
def beat(node):
    if not node.get_user_data():
        node.set_user_data("beating")
        node.get_logger().info("running")
"""
KEEP_THE_GIL = "ctypes.PyDLL(None).sleep(60)"  # Python's global lock


def dead_shared_memory(since_s: float) -> list[str]:
    """Files that dead nodes have left since then (Unix time).

    Not LTTng's: there is one per user, which the nodes of other tests make and give up meanwhile.
    """
    groups = _are_held(Path("/dev/shm"), since_s)
    names = [name for files, is_held in groups.items() if not is_held for name, _ in files]
    return [name for name in names if not name.startswith("lttng-")]


def is_stale(lock: Path) -> bool:
    """Whether the lock file of a domain is there, and nobody holds it."""
    with contextlib.suppress(OSError), open(lock) as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    return False


def stale_locks() -> list[str]:
    """Lock files of domains that nobody holds."""
    return [str(lock) for lock in Path("/tmp").glob("neuros-domain-*.lock") if is_stale(lock)]
