"""Stacks of plugins: reported for hooks that run for long, and for nodes that are killed.

A node tells it in its reports (:func:`stack_in`). While a library holds Python's global lock it
cannot report, and after its last report it does not: then the stack is written to a file of the
node (:class:`StackFile`), which the supervisor reads (:func:`held_stack`, :func:`held_threads`).

A node that stood still with its machine, or had no processor for seconds, cannot be told from one
whose lock is held. Its threads go on while the stack is written; the walk of another thread
through their frames (``faulthandler.dump_traceback_later``) may end in a segmentation fault: where
they never rest, after 4 to 150 times. So the main thread writes its own stack, on a signal, and all
threads are only written with the lock. A main thread that executes Python just then may still fail,
in the same program after 200 to 20,000 times.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import faulthandler
import json
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

LONG_S = 5.0
"""A hook that runs for this long is named."""

FILE_NAME = ".stack"
HELD_S = 4.0
"""A global lock that is held for this long has the stack written; nodes report more often."""

_MAIN_THREAD = "Stack (most recent call first):"  # as faulthandler says it
_ALL_THREADS = "Threads:"
_FRAME = re.compile(r'  File "(?P<file>.*)", line (?P<line>\d+) in (?P<name>.*)')


@dataclass(frozen=True)
class Stack:
    """The calls from a hook on, the most recent last, as Python shows them."""

    node: str
    hook: str
    text: str


class StackFile:
    """The file of a process; it stays empty, but for its first line, as long as that can report.

    Args:
        folder: where to make it.
        plugins: the files of plugins, by the name of the node.
    """

    def __init__(self, folder: Path, plugins: Mapping[str, Path]) -> None:
        # Paths as faulthandler writes them.
        dumped = {
            name: str(path).encode("ascii", "backslashreplace").decode()
            for name, path in plugins.items()
        }
        self._head = json.dumps(dumped).encode() + b"\n"
        self._descriptor = os.open(
            folder / FILE_NAME, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC
        )
        os.write(self._descriptor, self._head)
        faulthandler.register(_Timer.SIGNAL, self._descriptor, all_threads=False)
        self._timer = _Timer()

    def renew(self) -> None:
        """The process reports: only if it cannot do so again for a while the stack is written."""
        self._timer.start(HELD_S)
        if os.fstat(self._descriptor).st_size != len(self._head):
            os.ftruncate(self._descriptor, len(self._head))

    def leave(self) -> None:
        """The process has made its last report; what keeps it for a while is written."""
        thread = threading.Timer(HELD_S, self._write_threads)
        thread.daemon = True
        thread.start()

    def _write_threads(self) -> None:
        os.write(self._descriptor, f"{_ALL_THREADS}\n".encode())
        faulthandler.dump_traceback(self._descriptor)


class _Timer:
    """Sends the main thread a signal, also while Python's global lock is held (timer_create(2)).

    A system call that this interrupts begins anew (``SA_RESTART``), but for a few, sleeping among
    them (signal(7)). Where the kernel has no such timers, nothing is sent.
    """

    SIGNAL = signal.SIGRTMAX - 1  # no plugin is likely to use it

    _BY_THREAD = 4  # SIGEV_THREAD_ID

    class _Event(ctypes.Structure):
        _fields_ = (
            ("value", ctypes.c_void_p),
            ("signal", ctypes.c_int),
            ("notify", ctypes.c_int),
            ("thread", ctypes.c_int),
            ("reserved", ctypes.c_int * 12),
        )

    def __init__(self) -> None:
        thread = threading.main_thread().native_id or 0
        event = self._Event(signal=self.SIGNAL, notify=self._BY_THREAD, thread=thread)
        self._number = ctypes.c_void_p()
        self._library = ctypes.CDLL(None)
        if not hasattr(self._library, "timer_create"):
            self._library = ctypes.CDLL("librt.so.1")  # before version 2.34 of glibc
        clock, number = time.CLOCK_MONOTONIC, ctypes.byref(self._number)
        self._is_there = self._library.timer_create(clock, ctypes.byref(event), number) == 0
        # When Python ends it gives up its handler, and the signal would end the process.
        atexit.register(self._stop)

    def start(self, period_s: float) -> None:
        """Send it in so many seconds, and every so many seconds from then on; 0: not at all."""
        seconds, nanoseconds = divmod(round(period_s * 1e9), 10**9)
        if self._is_there:
            periods = (ctypes.c_long * 4)(seconds, nanoseconds, seconds, nanoseconds)
            self._library.timer_settime(self._number, 0, periods, None)

    def _stop(self) -> None:
        self.start(0.0)
        self._is_there = False  # for a thread that still reports


def stack_in(node: str, plugin: Path) -> Stack | None:
    """The stack of the main thread in a plugin, ``None`` outside of it. Any other thread."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    return _from_plugin({node: str(plugin)}, traceback.extract_stack(frame)) if frame else None


def held_stack(folder: Path) -> Stack | None:
    """The stack of the process with this file, ``None`` if it is able to report that itself."""
    plugins, dumps = _dumps(folder, _MAIN_THREAD)
    for lines in dumps:
        matches = [match for line in reversed(lines) if (match := _FRAME.match(line))]
        frames = [traceback.FrameSummary(m["file"], int(m["line"]), m["name"]) for m in matches]
        if stack := _from_plugin(plugins, frames):
            return stack
    return None


def held_threads(folder: Path) -> str:
    """Where the process with this file was when it could not report any more.

    As faulthandler shows it, the most recent call first: all threads, or else the main thread;
    empty if there is nothing of the kind.
    """
    dumps = [*_dumps(folder, _ALL_THREADS)[1], *_dumps(folder, _MAIN_THREAD)[1]]
    return next(("\n".join(lines) for lines in dumps if lines), "")


def _dumps(folder: Path, title: str) -> tuple[Mapping[str, str], Sequence[Sequence[str]]]:
    """The plugins of the process with this file, and what stands under this title, newest first.

    The newest may not be whole yet.
    """
    try:
        head, *lines = (folder / FILE_NAME).read_text("ascii", "replace").splitlines()
        plugins = json.loads(head)
    except (OSError, ValueError):
        return {}, ()
    found: list[list[str]] = []
    for line in lines:
        if line in (_MAIN_THREAD, _ALL_THREADS):
            found.append([line])
        elif found:
            found[-1].append(line)
    return plugins, [lines for first, *lines in reversed(found) if first == title]


def remove_stack_files(folders: Sequence[Path]) -> None:
    """Remove those that there are."""
    for folder in folders:
        with contextlib.suppress(OSError):
            (folder / FILE_NAME).unlink()


def _from_plugin(
    plugins: Mapping[str, str], frames: Sequence[traceback.FrameSummary]
) -> Stack | None:
    """The stack from the first call in one of the plugins on."""
    nodes = {path: node for node, path in reversed([*plugins.items()])}
    for place, frame in enumerate(frames):
        if frame.filename in nodes:
            text = "".join(traceback.format_list(list(frames[place:]))).rstrip("\n")
            return Stack(nodes[frame.filename], frame.name, text)
    return None
