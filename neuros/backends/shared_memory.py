"""Removes the shared memory that killed nodes and killed launchers leave behind.

A ROS node that ends by itself tidies up after itself; one that is killed leaves files in
``/dev/shm``. Fast DDS makes them in groups::

    fastrtps_<id>   fastrtps_port<n>     a segment, or a port: the memory itself
    ..._el   ..._sl                      its lock files: flock held while the owner lives
    sem.fastrtps_port<n>_mutex           its semaphore

The lock says whether the owner lives, also across containers; Fast DDS's own ``fastdds shm clean``
goes by it. A group with a free lock is dead, even while a former neighbour still maps it: that
neighbour keeps its mapping and opens a new port when a new node comes. A group without lock files
(its owner ended, but a killed neighbour never gave up its reference) is dead when nobody maps it.

``lttng-ust-wait-*`` is one file per machine and one per user, shared by everything that is linked
with LTTng; it goes when nobody maps it, and the next process makes it anew.

``neuros_<run id>_...`` holds the large packets of a run's nodes. Once the processes of that run are
gone it goes, and only then: the name says whose it is.

Where launcher and guardian were both killed, the next run removes ``neuros_<run id>_...`` and
``neuros_<run id>``, the folder that containers share, and so does ``neuros stop``. A living owner,
the launcher or the sender, has them locked (``flock``), and so is the mark of a living run; locks
are seen from everywhere, also where processes are not (from within a container).

Standard library only: the guardian runs this.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, TypeAlias

_FAST_DDS = re.compile(
    r"(?:sem\.)?(?P<base>fast(?:rtps|dds|_datasharing)_.+?)(?P<part>_el|_sl|_mutex)?"
)
_LTTNG = re.compile(r"lttng-ust-wait-.+")
_LOCKS = ("_el", "_sl")
# The kernel stamps files with a clock that is a tick (10 ms at most) behind time.time().
_CLOCK_SLACK_S = 0.05
_NAME = re.compile(r"neuros_(?P<run>[0-9a-f]{16})(?:_.*)?")
_LOOK_AGAIN_S = 0.1
MARK = "_mark"
"""End of the name of the file that marks a run while it is locked."""
_MOST_LOOKS = 20
_Files: TypeAlias = "tuple[tuple[str, int], ...]"  # names and inodes: they live and die together


def sweep(
    started_s: float, *, folder: Path = Path("/dev/shm"), look_again_s: float = _LOOK_AGAIN_S
) -> tuple[str, ...]:
    """Remove what dead nodes of this user left since ``started_s`` (Unix time, seconds).

    Samples every ``look_again_s``, and removes files that nobody holds in two samples in a row: a
    starting node makes its files a moment before it locks them. Files that are held three times
    in a row are in use: other sweeps, and Fast DDS in the neighbours, lock files for a moment to
    test them. Returns the names removed.
    """
    removed: list[str] = []
    looks: list[dict[_Files, bool]] = [_are_held(folder, started_s)]
    while looks[-1] and len(looks) < _MOST_LOOKS:
        time.sleep(look_again_s)
        now = _are_held(folder, started_s)
        for files in [each for each in now if not now[each] and looks[-1].get(each) is False]:
            for name, inode in files:
                with contextlib.suppress(OSError):
                    if os.lstat(folder / name).st_ino == inode:
                        os.unlink(folder / name)
                        removed.append(name)
            del now[files]
        looks.append(now)
        if all(look.get(files) for files in now for look in looks[-3:]) and len(looks) >= 3:
            break
    return tuple(removed)


class _Found(NamedTuple):
    files: dict[str, os.stat_result]
    locks: list[str]


def _are_held(folder: Path, started_s: float) -> dict[_Files, bool]:
    """Whether a process holds each group of files."""
    fresh = []
    for base, group in _groups(folder).items():
        since_s = 0.0 if _LTTNG.fullmatch(base) else started_s - _CLOCK_SLACK_S
        files = group.files.values()
        is_ours = all(file.st_uid == os.getuid() for file in files)
        if is_ours and any(file.st_mtime >= since_s for file in files):
            fresh.append(group)
    # Names that a process has mapped, as far as this user can see. All mappings are megabytes: the
    # search stops once it has found all names.
    prefix = f"{folder}/".encode()
    names = {name for group in fresh if not group.locks for name in group.files}
    mapped: set[str] = set()
    for pid in filter(str.isdigit, os.listdir("/proc")):
        if mapped >= names:
            break
        # Processes end meanwhile, and those of other users cannot be read.
        with contextlib.suppress(OSError), open(f"/proc/{pid}/maps", "rb") as maps:
            for line in maps:
                _, is_there, name = line.rstrip(b"\n").partition(prefix)
                if is_there:
                    mapped.add(os.fsdecode(name))
    held = {}
    for group in fresh:
        key = tuple(sorted((name, stat.st_ino) for name, stat in group.files.items()))
        if group.locks:
            held[key] = any(_inode_if_free(folder / name) is None for name in group.locks)
        else:
            held[key] = not mapped.isdisjoint(group.files)
    return held


def _groups(folder: Path) -> Mapping[str, _Found]:
    found: dict[str, _Found] = {}
    with contextlib.suppress(FileNotFoundError):
        for name in os.listdir(folder):
            match = _FAST_DDS.fullmatch(name)
            if not match and not _LTTNG.fullmatch(name):
                continue
            with contextlib.suppress(FileNotFoundError):
                stat = os.lstat(folder / name)
                group = found.setdefault(match["base"] if match else name, _Found({}, []))
                group.files[name] = stat
                if match and match["part"] in _LOCKS:
                    group.locks.append(name)
    return found


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
    """Remove the files of dead runs of this user; returns the names removed.

    A file counts if it has no lock twice: a new file is locked a moment later.
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
    """Names and inodes without a lock, of runs whose mark has none."""
    found: dict[str, int] = {}
    for name in os.listdir(folder) if folder.is_dir() else ():
        match = _NAME.fullmatch(name)
        inode = _inode_if_free(folder / name) if match else None
        if match and inode is not None:
            mark = folder / f"neuros_{match['run']}{MARK}"
            if read_if_held(mark) is None:
                found[name] = inode
    return found


def read_if_held(path: Path) -> bytes | None:
    """The beginning of a file that a process has locked; ``None``: it has no lock, or is none."""
    with contextlib.suppress(FileNotFoundError), _opened(path) as descriptor:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return os.read(descriptor, 1 << 20)
    return None


def _inode_if_free(path: Path) -> int | None:
    """The inode of a file or folder of this user without a lock."""
    with contextlib.suppress(OSError), _opened(path) as descriptor:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        status = os.fstat(descriptor)
        return status.st_ino if status.st_uid == os.getuid() else None
    return None


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[int]:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
