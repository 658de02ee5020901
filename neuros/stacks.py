"""Stacks of plugins: reported for hooks that run for long, and for nodes that are killed.

A node tells it in its reports (:func:`stack_in`). While a library holds Python's global lock it
cannot report, and after its last report it does not: then a thread in C, faulthandler's, writes the
stack to a file of the node (:class:`StackFile`), which the supervisor reads (:func:`held_stack`,
:func:`held_threads`). No signal is needed for that, so no system call of a plugin is interrupted,
and it also works in containers.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import re
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

_RENEW_S = 1.9
"""A timer of faulthandler is a thread: one per report is most of what an idle node does."""

_THREAD = re.compile(r"(?:Current thread|Thread) 0x0*(?P<ident>[0-9a-f]+)\b.*:")
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
        head = {"main": f"{threading.main_thread().ident or 0:x}", "plugins": dumped}
        self._head = json.dumps(head).encode() + b"\n"
        self._descriptor = os.open(
            folder / FILE_NAME, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC
        )
        os.write(self._descriptor, self._head)
        self._renewed_s = float("-inf")

    def renew(self) -> None:
        """The process reports: only if it cannot do so again for a while the stack is written."""
        now_s = time.monotonic()
        if now_s - self._renewed_s > _RENEW_S:
            self._renewed_s = now_s
            faulthandler.dump_traceback_later(HELD_S, repeat=True, file=self._descriptor)
        if os.fstat(self._descriptor).st_size != len(self._head):
            os.ftruncate(self._descriptor, len(self._head))


def stack_in(node: str, plugin: Path) -> Stack | None:
    """The stack of the main thread in a plugin, ``None`` outside of it. Any other thread."""
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    return _from_plugin({node: str(plugin)}, traceback.extract_stack(frame)) if frame else None


def held_stack(folder: Path) -> Stack | None:
    """The stack of the process with this file, ``None`` if it is able to report that itself."""
    try:
        head, *lines = (folder / FILE_NAME).read_text("ascii", "replace").splitlines()
        known = json.loads(head)
    except (OSError, ValueError):
        return None
    threads: dict[str, list[traceback.FrameSummary]] = {}  # of the last time that it was written
    frames: list[traceback.FrameSummary] = []
    for line in lines:
        if match := _THREAD.match(line):
            frames = threads[match["ident"]] = []
        elif match := _FRAME.match(line):
            frames.insert(
                0, traceback.FrameSummary(match["file"], int(match["line"]), match["name"])
            )
    main = threads.pop(known["main"], [])
    found = (_from_plugin(known["plugins"], frames) for frames in (main, *threads.values()))
    return next((stack for stack in found if stack), None)


def held_threads(folder: Path) -> str:
    """The stacks of all threads of the process with this file when it could not report any more.

    As faulthandler shows them, the most recent call first; empty if there is nothing of the kind.
    """
    try:
        _, *lines = (folder / FILE_NAME).read_text("ascii", "replace").splitlines()
    except (OSError, ValueError):
        return ""
    begins = [place for place, line in enumerate(lines) if line.startswith("Timeout (")]
    return "\n".join(lines[begins[-1] + 1 :]) if begins else ""


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
