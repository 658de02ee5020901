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

Where launcher and reaper were both killed, the next run removes ``neuros_<run id>_...`` and
``neuros_<run id>``, the folder that containers share, and so does ``neuros stop``. A living owner,
the launcher or the sender, has them locked (``flock``); locks are seen from everywhere, also where
processes are not (from within a container). Nodes may live on for some seconds.

Standard library only: the reaper runs this.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Set
from pathlib import Path
from typing import NamedTuple, TypeAlias

from neuros.backends.run_processes import RunProcesses

_FAST_DDS = re.compile(
    r"(?:sem\.)?(?P<base>fast(?:rtps|dds|_datasharing)_.+?)(?P<part>_el|_sl|_mutex)?"
)
_LTTNG = re.compile(r"lttng-ust-wait-.+")
_LOCKS = ("_el", "_sl")
# The kernel stamps files with a clock that is a tick (10 ms at most) behind time.time().
_CLOCK_SLACK_S = 0.05
_NAME = re.compile(r"neuros_(?P<run>[0-9a-f]{16})(?:_.*)?")
_LOOK_AGAIN_S = 0.1
_MOST_LOOKS = 20
_UNSEEN = 0  # the holder of a lock in another container, or of another user
_Files: TypeAlias = "tuple[tuple[str, int], ...]"  # names and inodes: they live and die together


def remove_segments(run_id: str, *, folder: Path = Path("/dev/shm")) -> tuple[str, ...]:
    """Remove what a run, none of whose processes is left, had in shared memory for large packets.

    Returns the names removed.
    """
    mine: list[tuple[str, int]] = []
    with contextlib.suppress(FileNotFoundError):
        for name in os.listdir(folder):
            if name.startswith(f"neuros_{run_id}_"):
                with contextlib.suppress(FileNotFoundError):
                    status = os.lstat(folder / name)
                    if status.st_uid == os.getuid():
                        mine.append((name, status.st_ino))
    return tuple(_remove(folder, mine))


def sweep(
    started_s: float, *, folder: Path = Path("/dev/shm"), look_again_s: float = _LOOK_AGAIN_S
) -> tuple[str, ...]:
    """Remove what dead nodes of this user left since ``started_s`` (Unix time, seconds).

    Looks every ``look_again_s``, and removes what nobody holds in two looks in a row: a node that
    is just starting makes its files a moment before it locks them. What the same process holds
    twice in a row is alive. A holder that changes is no owner: other sweeps, and Fast DDS in the
    neighbours, lock files for a moment to see whether they can. Returns the names removed.
    """
    removed: list[str] = []
    before = _holders(folder, started_s)
    for _ in range(_MOST_LOOKS):
        if not before:
            break
        time.sleep(look_again_s)
        now = {
            files: held for files, held in _holders(folder, started_s).items() if files in before
        }
        for files, held in now.items():
            if not held and not before[files]:
                removed += _remove(folder, files)
        before = {
            files: held
            for files, held in now.items()
            if held != before[files] and held.isdisjoint(before[files])
        }
    return tuple(removed)


class _Found(NamedTuple):  # a dataclass would take the reaper 10 ms to import
    files: dict[str, os.stat_result]
    locks: list[str]


def _holders(folder: Path, started_s: float) -> dict[_Files, set[int]]:
    """Who holds each group of files: process ids, :data:`_UNSEEN` for one that cannot be seen."""
    fresh = [
        group
        for base, group in _groups(folder).items()
        if _is_ours(group.files.values(), started_s if not _LTTNG.fullmatch(base) else 0.0)
    ]
    used = _users(folder, {name for group in fresh if not group.locks for name in group.files})
    owners = _lock_owners() if any(group.locks for group in fresh) else {}
    held = {}
    for group in fresh:
        files = tuple(sorted((name, stat.st_ino) for name, stat in group.files.items()))
        if group.locks:
            holders = set().union(*(owners.get(_lock(group.files[n]), ()) for n in group.locks))
            if not holders and any(_inode_if_free(folder / n) is None for n in group.locks):
                holders = {_UNSEEN}
        else:
            holders = set().union(*(used.get(name, ()) for name in group.files))
        held[files] = holders
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


def _is_ours(stats: Iterable[os.stat_result], started_s: float) -> bool:
    stats = list(stats)
    return all(stat.st_uid == os.getuid() for stat in stats) and any(
        stat.st_mtime >= started_s - _CLOCK_SLACK_S for stat in stats
    )


def _lock(stat: os.stat_result) -> str:
    """A file as ``/proc/locks`` names it."""
    return f"{os.major(stat.st_dev):02x}:{os.minor(stat.st_dev):02x}:{stat.st_ino}"


def _lock_owners() -> Mapping[str, set[int]]:
    """The processes, as far as they can be seen, that have a file locked with ``flock``."""
    owners: dict[str, set[int]] = {}
    with contextlib.suppress(OSError), open("/proc/locks", encoding="ascii") as locks:
        for line in locks:  # 1: FLOCK  ADVISORY  WRITE 5301 00:1b:77 0 EOF; "1: -> ..." waits
            fields = line.split()
            if fields[1] == "FLOCK":
                owners.setdefault(fields[5], set()).add(int(fields[4]))
    return owners


def _users(folder: Path, names: Set[str]) -> Mapping[str, set[int]]:
    """Processes, as far as they can be seen, that have ``names`` in ``folder`` mapped.

    One or more for each name in use: the mappings of all processes are megabytes, and the oldest
    users are the same in the next look.
    """
    prefix = f"{folder}/"
    users: dict[str, set[int]] = {}
    for pid in sorted(map(int, filter(str.isdigit, os.listdir("/proc")))):
        if users.keys() >= names:
            break
        # Processes end while we look, and those of other users do not let us in.
        with contextlib.suppress(OSError), open(f"/proc/{pid}/maps", "rb") as maps:
            for line in maps:
                at = line.find(prefix.encode())
                if at >= 0:
                    name = os.fsdecode(line[at + len(prefix) :].rstrip(b"\n"))
                    users.setdefault(name, set()).add(pid)
    return users


def _remove(folder: Path, files: Iterable[tuple[str, int]]) -> Iterator[str]:
    for name, inode in files:
        with contextlib.suppress(OSError):
            if os.lstat(folder / name).st_ino == inode:
                os.unlink(folder / name)
                yield name


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
    """Names and inodes without a lock, of runs without processes."""
    found: dict[str, int] = {}
    is_alive = functools.cache(lambda run: bool(RunProcesses(run).alive()))
    for name in os.listdir(folder) if folder.is_dir() else ():
        match = _NAME.fullmatch(name)
        inode = _inode_if_free(folder / name) if match else None
        if match and inode is not None and not is_alive(match["run"]):
            found[name] = inode
    return found


def _inode_if_free(path: Path) -> int | None:
    """The inode of a file or folder of this user without a lock."""
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            status = os.fstat(descriptor)
            return status.st_ino if status.st_uid == os.getuid() else None
        finally:
            os.close(descriptor)
    return None
