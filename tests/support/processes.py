"""The processes of a run, found by what they were started with."""

from __future__ import annotations

import os
from pathlib import Path


def processes_of(mark: object) -> dict[int, str]:
    """The commands, by process id, of other processes that have this in their command line."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except OSError:
            continue
        if str(mark) in command and int(entry.name) != os.getpid():
            found[int(entry.name)] = command
    return found


def is_alive(pid: int) -> bool:
    """Whether a process may still hold files: its command line is gone a moment before them."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return False
    return stat[stat.rindex(b")") + 2 :][:1] not in (b"Z", b"X")
