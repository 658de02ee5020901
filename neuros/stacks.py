"""Stacks of plugins: of hooks that run for long, and of nodes that are killed.

A node that reports tells its own (:func:`stack_in`). One that does not, since a library holds
Python's global lock or its process was stopped, cannot: then py-spy reads from outside where its
threads stand (:func:`threads_of`). It only reads memory, so it changes nothing in the node;
faulthandler, which writes stacks from inside, may crash a node that goes on meanwhile.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import subprocess
import sys
import threading
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

LONG_S = 5.0
"""A hook that runs for this long is named."""

_READ_S = 2.0
_MAIN_THREAD = "MainThread"
_PR_SET_PTRACER, _ANY = 0x59616D61, -1  # prctl(2), ptrace(2)


@dataclass(frozen=True)
class Stack:
    """The calls from a hook on, the most recent last, as Python shows them."""

    node: str
    hook: str
    text: str


@dataclass(frozen=True)
class Thread:
    """A thread of another process.

    Attributes:
        name: in Python.
        is_main: whether it is the one in which hooks run.
        has_lock: whether it holds Python's global lock.
        frames: file, line and function of each call, the most recent last.
    """

    name: str
    is_main: bool
    has_lock: bool
    frames: tuple[tuple[str, int, str], ...]

    def __str__(self) -> str:
        does = " holds Python's global lock" if self.has_lock else ""
        return f"{self.name}{does}:\n{_text(self.frames)}"


@dataclass(frozen=True)
class ProcessThreads:
    """Where the threads of a process stand in Python; empty if that could not be read.

    Attributes:
        is_stopped: whether the process was stopped (SIGSTOP), so that none of them goes on.
    """

    threads: tuple[Thread, ...] = ()
    is_stopped: bool = False

    def __str__(self) -> str:
        return "\n".join(map(str, self.threads))

    @property
    def lock_holder(self) -> Thread | None:
        """The thread that keeps the others from going on."""
        return next((each for each in self.threads if each.has_lock), None)

    def hook_stack(self, plugins: Mapping[str, str]) -> Stack | None:
        """The stack of the main thread in one of these plugins (their files, by node)."""
        main = next((each for each in self.threads if each.is_main), None)
        return _from_plugin(plugins, main.frames) if main else None

    def stack(self, plugins: Mapping[str, str]) -> Stack | None:
        """The stack in a plugin of the thread that holds the lock, or else of the main thread."""
        holder = self.lock_holder
        return _from_plugin(plugins, holder.frames) if holder else self.hook_stack(plugins)


def threads_of(pid: int) -> ProcessThreads:
    """Read where the threads of a process on this machine stand."""
    command = [_py_spy(), "dump", "--nonblocking", "--json", "--pid", str(pid)]
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_READ_S,
            check=True,
            start_new_session=True,  # Ctrl+C is not for it
        )
        threads = [_thread(each, pid) for each in json.loads(done.stdout)]
        with open(f"/proc/{pid}/stat", "rb") as file:
            state = file.read().rpartition(b") ")[2][:1]
    except (OSError, subprocess.SubprocessError, ValueError):  # it may have ended meanwhile
        return ProcessThreads()
    threads.sort(key=lambda each: not each.is_main)
    return ProcessThreads(tuple(threads), state in (b"T", b"t"))


def allow_reading() -> None:
    """Let :func:`threads_of` read this process, where only its parents might (Yama)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PTRACER, ctypes.c_ulong(_ANY), 0, 0, 0)


def stack_in(node: str, plugin: Path) -> Stack | None:
    """The stack of the main thread in a plugin, ``None`` outside of it. Any other thread."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    if frame is None:
        return None
    frames = [(f.filename, f.lineno or 0, f.name) for f in traceback.extract_stack(frame)]
    return _from_plugin({node: str(plugin)}, frames)


@cache
def _py_spy() -> str:
    """The program, which the distribution of that name has installed somewhere."""
    from importlib.metadata import PackageNotFoundError, files

    with contextlib.suppress(PackageNotFoundError):
        for path in files("py-spy") or ():
            if path.name == "py-spy":
                return str(path.locate())
    return "py-spy"


def _thread(told: Mapping[str, Any], pid: int) -> Thread:
    """A thread as py-spy tells of it, with the most recent call first."""
    frames = [(f["filename"], f["line"], f["name"].rpartition(".")[2]) for f in told["frames"]]
    name = told["thread_name"] or ""  # which the module threading gives, if it is loaded
    is_main = name == _MAIN_THREAD or told["os_thread_id"] == pid
    return Thread(name or "a thread", is_main, told["owns_gil"], (*reversed(frames),))


def _from_plugin(
    plugins: Mapping[str, str], frames: Sequence[tuple[str, int, str]]
) -> Stack | None:
    """The stack from the first call in one of the plugins on."""
    nodes = {path: node for node, path in reversed([*plugins.items()])}
    for place, (path, _, name) in enumerate(frames):
        if path in nodes:
            return Stack(nodes[path], name, _text(frames[place:]))
    return None


def _text(frames: Sequence[tuple[str, int, str]]) -> str:
    return "".join(traceback.format_list([traceback.FrameSummary(*f) for f in frames])).rstrip("\n")
