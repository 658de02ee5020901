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
import os
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

IMPORT = "<module>"
"""What Python calls the function of a module that is imported, in stacks."""

_READ_S = 2.0
_MOST_FRAMES = 100  # shown, as by faulthandler
_MAIN_THREAD = "MainThread"
_STOPPED = "the process is stopped"  # by SIGSTOP, or a debugger
_PR_SET_PTRACER, _ANY = 0x59616D61, -1  # prctl(2), ptrace(2)
_INIT = 1


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
        has_lock: whether it held Python's global lock when it was read.
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
    """Where the threads of a process stand in Python.

    Attributes:
        stopped: why none of them goes on ("the process is stopped"); empty if they may.
        problem: why they could not be read; empty if they could.
    """

    threads: tuple[Thread, ...] = ()
    stopped: str = ""
    problem: str = ""

    def __str__(self) -> str:
        return "\n".join(map(str, self.threads))

    @property
    def lock_holder(self) -> Thread | None:
        """The thread that held Python's global lock."""
        return next((each for each in self.threads if each.has_lock), None)

    def hook_stack(self, node: str, plugin: str) -> Stack | None:
        """The stack of the main thread in the plugin of a node, whose file this is."""
        frames = next((each.frames for each in self.threads if each.is_main), ())
        for place, (path, _, name) in enumerate(frames):
            if path == plugin:
                return Stack(node, name, _text(frames[place:]))
        return None


def threads_of(pid: int) -> ProcessThreads:
    """Read where the threads of a process on this machine stand; takes up to 2 s."""
    import subprocess  # no node needs it, and each would take 5 ms to import it

    command = [_py_spy(), "dump", "--nonblocking", "--json", "--pid", str(pid)]
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_READ_S,
            check=False,
            start_new_session=True,  # Ctrl+C is not for it
        )
        if done.returncode:
            said = done.stderr.decode(errors="replace").partition("\n")[0]
            return ProcessThreads(problem=f"py-spy: {said.removeprefix('Error: ')}")
        threads = [_thread(each, pid) for each in json.loads(done.stdout)]
        with open(f"/proc/{pid}/stat", "rb") as file:
            state = file.read().rpartition(b") ")[2][:1]
    except FileNotFoundError:
        return ProcessThreads(problem="py-spy is not installed, or the process has ended")
    except subprocess.TimeoutExpired:
        return ProcessThreads(problem=f"py-spy did not answer within {_READ_S:g} s")
    except (OSError, ValueError, LookupError, TypeError) as error:
        return ProcessThreads(problem=f"py-spy: {error}")
    threads.sort(key=lambda each: not each.is_main)
    return ProcessThreads(tuple(threads), _STOPPED if state in (b"T", b"t") else "")


def allow_reading() -> None:
    """Let :func:`threads_of` read this process where Yama would allow it to ancestors only.

    Then the launcher may, and its children; it has started the reaper, which has started this
    process. In a container, where that is not to be seen, any process of the same user may.
    """
    reader = _ANY
    with contextlib.suppress(OSError), open(f"/proc/{os.getppid()}/stat", "rb") as file:
        launcher = int(file.read().rpartition(b") ")[2].split()[1])
        reader = launcher if launcher > _INIT else _ANY
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PTRACER, ctypes.c_ulong(reader), 0, 0, 0)


def stack_in(node: str, plugin: Path) -> Stack | None:
    """The stack of the main thread in a plugin, ``None`` outside of it. Any other thread."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    frames = traceback.extract_stack(frame) if frame else []
    for place, each in enumerate(frames):
        if each.filename == str(plugin):
            text = "".join(traceback.format_list(frames[place:])).rstrip("\n")
            return Stack(node, each.name, text)
    return None


@cache
def _py_spy() -> str:
    """The path of the program."""
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


def _text(frames: Sequence[tuple[str, int, str]]) -> str:
    """As Python shows calls, but without their source: a node says which files these are."""
    lines = [f'  File "{path}", line {line}, in {name}' for path, line, name in frames]
    if len(lines) > _MOST_FRAMES:
        lines[1 : 1 - _MOST_FRAMES] = [f"  [{len(lines) - _MOST_FRAMES} calls are left out]"]
    return "\n".join(lines)
