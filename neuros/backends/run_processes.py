"""Processes of a run on this machine, read from ``/proc``.

Standard library only: the reaper runs this.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import NamedTuple

RUN_ID = "NEUROS_RUN_ID"
"""The environment variable that every process of a run inherits."""

_NODE_FOLDER = b"NEUROS_RUN_DIR="


class _Process(NamedTuple):  # a dataclass would take the reaper 10 ms to import
    """One line of ``/proc/<pid>/stat``; ``start`` (clock ticks) tells it from a later namesake."""

    pid: int
    parent: int
    session: int
    start: int
    is_gone: bool


class RunProcesses:
    """The processes of one run, without the process that asks.

    Args:
        ancestor: its descendants belong to the run, too.

    Remembers whom it has seen, so that a process stays known whose environment can no longer be
    read because it is just ending.
    """

    def __init__(self, run_id: str, ancestor: int = -1) -> None:
        self._ancestor = ancestor
        self._mark = f"{RUN_ID}={run_id}".encode()
        self._sessions: dict[int, int] = {}
        self._known: dict[int, int] = {}

    def add_session(self, pid: int) -> None:
        """All processes of the session that ``pid`` leads belong to the run."""
        process = _read(pid)
        # A node process that has ended already may have left children in its session.
        self._sessions[pid] = process.start if process else -1

    def alive(self) -> dict[int, int]:
        """Process ids and start times of all that still run; zombies do not count."""
        processes = {process.pid: process for process in _all()}
        processes.pop(os.getpid(), None)
        members = {pid for pid, process in processes.items() if self._is_member(process, processes)}
        while children := {
            pid
            for pid, process in processes.items()
            if process.parent in members and pid not in members
        }:
            members |= children
        self._known = {
            pid: processes[pid].start
            for pid in members
            if not processes[pid].is_gone and _may_be_killed(pid)
        }
        return dict(self._known)

    def nodes(self) -> dict[int, str]:
        """Process ids of those that were started for one node, and the name of that node."""
        found: dict[int, str] = {}
        for pid in self.alive():
            for variable in environ_of(pid):
                if variable.startswith(_NODE_FOLDER):
                    found[pid] = os.fsdecode(variable.rpartition(b"/")[2])
        return found

    def _is_member(self, process: _Process, processes: dict[int, _Process]) -> bool:
        if self._known.get(process.pid) == process.start or process.parent == self._ancestor:
            return True
        start = self._sessions.get(process.session)
        if start is not None and _is_same_leader(processes.get(process.session), start):
            return True
        return self._mark in environ_of(process.pid)


def environ_of(pid: int) -> list[bytes]:
    """The environment that a process was started with, empty if it cannot be read."""
    with contextlib.suppress(OSError), open(f"/proc/{pid}/environ", "rb") as file:
        return file.read().split(b"\0")
    return []


def started_at(pid: int) -> int | None:
    """When a process started, in clock ticks since boot; ``None`` if there is none."""
    process = _read(pid)
    return None if process is None or process.is_gone else process.start


def _is_same_leader(leader: _Process | None, start: int) -> bool:
    """While a session has members, the number of its dead leader is not given out again."""
    return leader is None or leader.start == start


def _may_be_killed(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except OSError:  # gone, or it has become another user's (sudo)
        return False
    return True


def _all() -> Iterator[_Process]:
    for name in filter(str.isdigit, os.listdir("/proc")):
        if process := _read(int(name)):
            yield process


def _read(pid: int) -> _Process | None:
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            text = file.read()
    except OSError:
        return None
    # pid (name) state ppid pgrp session ...; the name may hold spaces and brackets (proc(5))
    fields = text[text.rindex(b")") + 2 :].split()
    state, threads = fields[0], int(fields[17])
    # A dead main thread makes a zombie of the process while other threads still run.
    is_gone = state in (b"Z", b"X") and threads <= 1
    return _Process(pid, int(fields[1]), int(fields[3]), int(fields[19]), is_gone)
