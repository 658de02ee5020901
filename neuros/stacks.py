"""Stacks of plugins: of long hooks, and of nodes that are killed.

A node reads its own stack (:func:`stack_in`). If a library holds Python's global lock, or the
process is stopped, py-spy reads the stacks from outside (:func:`threads_of`). It only reads memory,
and does not disturb the node; faulthandler, which writes stacks from inside, may crash it.
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
from pathlib import Path
from typing import Any

LONG_S = 5.0
"""A hook that runs for this many seconds is reported."""

IMPORT = "<module>"
"""The name of a module's own code in stacks, as while it is imported."""

_READ_S = 2.0
_MOST_FRAMES = 100  # shown, as by faulthandler
_MAIN_THREAD = "MainThread"
_STOPPED = "the process is stopped"  # by SIGSTOP, or a debugger
_PR_SET_PTRACER, _ANY = 0x59616D61, -1  # prctl(2), ptrace(2)
_INIT = 1


@dataclass(frozen=True)
class Stack:
    """The calls from a hook on, the most recent last, in Python's format."""

    node: str
    hook: str
    text: str


@dataclass(frozen=True)
class Thread:
    """A thread of another process.

    Attributes:
        name: in Python.
        is_main: whether hooks run in the thread.
        has_lock: whether the thread held Python's global lock.
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
    """The stacks of the threads of a process.

    Attributes:
        stopped: why no thread runs ("the process is stopped"); empty if they may.
        problem: why the stacks could not be read; empty if they could.
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
        """The stack of the main thread from the file ``plugin`` on; ``None`` outside of it."""
        frames = next((each.frames for each in self.threads if each.is_main), ())
        for place, (path, _, name) in enumerate(frames):
            if path == plugin:
                return Stack(node, name, _text(frames[place:]))
        return None


def threads_of(pid: int) -> ProcessThreads:
    """Read the stacks of a process on this machine; takes up to 2 s."""
    import importlib.metadata as metadata
    import subprocess  # an import takes 5 ms, in nodes that do not need it

    program = "py-spy"
    with contextlib.suppress(metadata.PackageNotFoundError):
        found = (path for path in metadata.files("py-spy") or () if path.name == "py-spy")
        program = next((str(path.locate()) for path in found), program)
    command = [program, "dump", "--nonblocking", "--json", "--pid", str(pid)]
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_READ_S,
            check=False,
            start_new_session=True,  # keeps Ctrl+C away
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
    """Let :func:`threads_of` read this process although Yama allows ancestors only.

    The launcher and its children may: the launcher starts the guardian, which starts this process.
    In a container, where the launcher is invisible, any process of the same user may.
    """
    reader = _ANY
    with contextlib.suppress(OSError), open(f"/proc/{os.getppid()}/stat", "rb") as file:
        launcher = int(file.read().rpartition(b") ")[2].split()[1])
        reader = launcher if launcher > _INIT else _ANY
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PTRACER, ctypes.c_ulong(reader), 0, 0, 0)


def stack_in(node: str, plugin: Path) -> Stack | None:
    """The stack of the main thread from a plugin on, ``None`` outside of it. Other threads."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    frames = traceback.extract_stack(frame) if frame else []
    for place, each in enumerate(frames):
        if each.filename == str(plugin):
            text = "".join(traceback.format_list(frames[place:])).rstrip("\n")
            return Stack(node, each.name, text)
    return None


def _thread(told: Mapping[str, Any], pid: int) -> Thread:
    """A thread from py-spy's report, which has the most recent call first."""
    frames = [(f["filename"], f["line"], f["name"].rpartition(".")[2]) for f in told["frames"]]
    name = told["thread_name"] or ""  # empty if the module threading is not loaded
    is_main = name == _MAIN_THREAD or told["os_thread_id"] == pid
    return Thread(name or "a thread", is_main, told["owns_gil"], (*reversed(frames),))


def _text(frames: Sequence[tuple[str, int, str]]) -> str:
    """Calls in Python's format without source lines: the files may be elsewhere."""
    lines = [f'  File "{path}", line {line}, in {name}' for path, line, name in frames]
    if len(lines) > _MOST_FRAMES:
        lines[1 : 1 - _MOST_FRAMES] = [f"  [{len(lines) - _MOST_FRAMES} calls are left out]"]
    return "\n".join(lines)
