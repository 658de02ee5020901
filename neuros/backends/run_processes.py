"""Processes of this machine, read from ``/proc``, and what a process shows of itself there.

Standard library only: the guardian runs this.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

RUN_ID = "NEUROS_RUN_ID"
"""The environment variable that every process of a run inherits."""

_NODE_FOLDER = b"NEUROS_RUN_DIR="
_PR_SET_MM, _PR_SET_MM_MAP = 35, 14


class _Process(NamedTuple):
    """One line of ``/proc/<pid>/stat``; ``start`` (clock ticks) tells it from a later namesake."""

    pid: int
    parent: int
    start: int
    is_gone: bool


class RunProcesses:
    """The processes of one run, by the run's id in their environment, without this process."""

    def __init__(self, run_id: str) -> None:
        self._mark = f"{RUN_ID}={run_id}".encode()

    def alive(self) -> list[int]:
        others = (int(name) for name in _numbers() if int(name) != os.getpid())
        return [pid for pid in others if self._mark in environ_of(pid) and started_at(pid)]

    def nodes(self) -> dict[int, str]:
        """Process ids of processes that were started for one node, and the name of the node."""
        found: dict[int, str] = {}
        for pid in self.alive():
            for variable in environ_of(pid):
                if variable.startswith(_NODE_FOLDER):
                    found[pid] = os.fsdecode(variable.rpartition(b"/")[2])
        return found


def children() -> list[int]:
    """Process ids of the children of this process, but for zombies and other users' (sudo)."""
    found = []
    for name in _numbers():
        process = _read(int(name))
        if process and process.parent == os.getpid() and not process.is_gone:
            with contextlib.suppress(OSError):  # it may be gone by now
                os.kill(process.pid, 0)
                found.append(process.pid)
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


def show_as(command: Sequence[str], environment: Mapping[str, str]) -> bool:
    """Show a command and an environment in ``/proc`` as this process's own; False: impossible.

    It is what ``execve`` does for a program: tools such as ``ps`` read nothing else. Linux lets
    any process do it (``PR_SET_MM_MAP``, prctl(2)), unless it was built without.
    """
    words = b"".join(os.fsencode(word) + b"\0" for word in command)
    variables = b"".join(os.fsencode(f"{k}={v}") + b"\0" for k, v in environment.items())
    shown = ctypes.create_string_buffer(words + variables)
    start = ctypes.addressof(shown)
    arguments = start, start + len(words)
    libc = ctypes.CDLL(None, use_errno=True)
    libc.sbrk.restype = ctypes.c_void_p
    with open("/proc/self/stat", "rb") as file:
        text = file.read()
    # The fields from the third one on, by their numbers in proc(5).
    field = dict(enumerate(map(int, text[text.rindex(b")") + 4 :].split()), 4))
    code, data = (field[26], field[27]), (field[45], field[46])
    heap = field[47], libc.sbrk(0)
    # struct prctl_mm_map of <linux/prctl.h>, with auxiliary vector and program as they are.
    places = *code, *data, *heap, field[28], *arguments, arguments[1], start + len(shown) - 1
    given = struct.pack("11QQII", *places, 0, 0, 0xFFFFFFFF)
    size = ctypes.c_ulong(len(given))
    is_shown = bool(libc.prctl(_PR_SET_MM, _PR_SET_MM_MAP, given, size, 0) == 0)
    if is_shown:
        # The kernel reads it there from now on, also while Python frees all that it holds at exit.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(shown))
    return is_shown


def _numbers() -> Iterator[str]:
    return filter(str.isdigit, os.listdir("/proc"))


def _read(pid: int) -> _Process | None:
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            text = file.read()
    except OSError:
        return None
    # pid (name) state ppid ...; the name may hold spaces and brackets (proc(5))
    fields = text[text.rindex(b")") + 2 :].split()
    state, threads = fields[0], int(fields[17])
    # A dead main thread makes a zombie of the process while other threads still run.
    is_gone = state in (b"Z", b"X") and threads <= 1
    return _Process(pid, int(fields[1]), int(fields[19]), is_gone)
