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
    """The processes of one run, without this process.

    A process stays known when it is ending and its environment can no longer be read.

    Args:
        ancestor: a process whose descendants belong to the run, too.
    """

    def __init__(self, run_id: str, ancestor: int = -1) -> None:
        self._ancestor = ancestor
        self._mark = f"{RUN_ID}={run_id}".encode()
        self._sessions: dict[int, int] = {}
        self._known: dict[int, int] = {}

    def add_session(self, pid: int) -> None:
        """Add all processes of the session that ``pid`` leads."""
        process = _read(pid)
        # A node process that has ended already may have left children in its session.
        self._sessions[pid] = process.start if process else -1

    def alive(self) -> dict[int, int]:
        """Process ids and start times of all processes but zombies."""
        processes = {process.pid: process for process in _all()}
        processes.pop(os.getpid(), None)
        members = set()
        for pid, process in processes.items():
            leader, start = processes.get(process.session), self._sessions.get(process.session)
            if (
                self._known.get(pid) == process.start
                or process.parent == self._ancestor
                # While a session has members, the number of its dead leader is not given out again.
                or (start is not None and (leader is None or leader.start == start))
                or self._mark in environ_of(pid)
            ):
                members.add(pid)
        while children := {
            pid
            for pid, process in processes.items()
            if process.parent in members and pid not in members
        }:
            members |= children
        self._known = {}
        for pid in members:
            # Some are gone by now, or have become another user's (sudo).
            with contextlib.suppress(OSError):
                os.kill(pid, 0)
                if not processes[pid].is_gone:
                    self._known[pid] = processes[pid].start
        return dict(self._known)

    def nodes(self) -> dict[int, str]:
        """Process ids of processes that were started for one node, and the name of the node."""
        found: dict[int, str] = {}
        for pid in self.alive():
            for variable in environ_of(pid):
                if variable.startswith(_NODE_FOLDER):
                    found[pid] = os.fsdecode(variable.rpartition(b"/")[2])
        return found


def environ_of(pid: int) -> list[bytes]:
    """The environment at the start of a process; empty if it cannot be read."""
    with contextlib.suppress(OSError), open(f"/proc/{pid}/environ", "rb") as file:
        return file.read().split(b"\0")
    return []


def started_at(pid: int) -> int | None:
    """When a process started, in clock ticks since boot; ``None`` if there is none."""
    process = _read(pid)
    return None if process is None or process.is_gone else process.start


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
