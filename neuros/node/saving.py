"""Files that a plugin writes while its node finalises.

A file may grow late: Python writes it in pieces of 8 KiB, some libraries only when they close it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

_LONGEST_S = 60.0
"""A file that stays open for longer, and does not grow, is no progress."""


class Saving:
    """The files that a node has opened for writing, in its folder, since it began to finalise."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._since_s = time.monotonic()
        self._before = {*self._open_files()}

    @property
    def is_writing(self) -> bool:
        """Whether one of them is open. Any thread."""
        if time.monotonic() - self._since_s > _LONGEST_S:
            return False
        return any(each not in self._before for each in self._open_files())

    def _open_files(self) -> Iterator[Path]:
        for number in os.listdir("/proc/self/fd"):
            try:
                path = Path(os.readlink(f"/proc/self/fd/{number}"))
                info = Path(f"/proc/self/fdinfo/{number}").read_text("ascii")
            except OSError:  # closed meanwhile, this listing itself among them
                continue
            flags = int(info.split("flags:", 1)[1].split(None, 1)[0], 8)
            if flags & os.O_ACCMODE != os.O_RDONLY and path.is_relative_to(self._folder):
                yield path
