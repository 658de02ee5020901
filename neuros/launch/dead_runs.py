"""What runs have left in shared memory whose launcher and guardian were both killed.

Nobody is there to tidy up after such a run, so that the next one does, and ``neuros stop``. In
``/dev/shm`` it may leave ``neuros_<run id>``, the folder that its containers share, and
``neuros_<run id>_...``, large packets. Both are locked (``flock``) by a living owner, the launcher
or the sender; locks are seen from everywhere, also where processes are not (from within a
container). Nodes may live on for some seconds.

Standard library only: the guardian runs this.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import time
from pathlib import Path

from neuros.launch.run_processes import RunProcesses

_NAME = re.compile(r"neuros_(?P<run>[0-9a-f]{16})(?:_.*)?")
_LOOK_AGAIN_S = 0.1


def hold(folder: Path) -> int:
    """Lock a folder for as long as this process lives; returns the descriptor that does it.

    Raises:
        OSError: if it cannot be opened.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    fcntl.flock(descriptor, fcntl.LOCK_SH)
    return descriptor


def remove_dead_runs(
    folder: Path = Path("/dev/shm"), *, look_again_s: float = _LOOK_AGAIN_S
) -> tuple[str, ...]:
    """Remove what dead runs of this user have left; returns the names removed.

    Looks twice: what has just been made is locked a moment later.
    """
    first = _dead(folder)
    if not first:
        return ()
    time.sleep(look_again_s)
    second = _dead(folder)
    names = sorted(name for name, inode in first.items() if second.get(name) == inode)
    for name in names:
        path = folder / name
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    return tuple(names)


def _dead(folder: Path) -> dict[str, int]:
    """Names and inodes of what nobody holds, of runs without processes."""
    found: dict[str, int] = {}
    is_alive: dict[str, bool] = {}
    for name in os.listdir(folder) if folder.is_dir() else ():
        match = _NAME.fullmatch(name)
        inode = _inode_if_free(folder / name) if match else None
        if match and inode is not None:
            run = match["run"]
            if run not in is_alive:
                is_alive[run] = bool(RunProcesses(run).alive())
            if not is_alive[run]:
                found[name] = inode
    return found


def _inode_if_free(path: Path) -> int | None:
    """The inode of a file or folder of this user that nobody has locked."""
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            status = os.fstat(descriptor)
            return status.st_ino if status.st_uid == os.getuid() else None
        finally:
            os.close(descriptor)
    return None
