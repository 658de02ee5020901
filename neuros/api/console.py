"""What the user sees of a run: the launcher's own records, and the lines that nodes log."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TextIO

from neuros.api.progress_line import ProgressLine
from neuros.launch.console import LAYOUT, LogTail, NonBlockingWriter, format_record, wants_colours
from neuros.launch.progress import Progress


class Console:
    """Where a run is shown; nothing here waits for a reader but :meth:`finish`.

    Args:
        stream: where to write, ``None``: nowhere.
        logs: the log files to show, by name.
        is_enough: whether the user wants no more of it (asked while it waits).
        translate: from what nodes say to what the user knows (names of paths).
        shows_progress: whether to show how far the run has come; ``None``: if its end is known.
    """

    def __init__(
        self,
        stream: TextIO | None,
        logs: Mapping[str, Path],
        is_enough: Callable[[], bool],
        translate: Callable[[str], str] = str,
        *,
        shows_progress: bool | None = None,
    ) -> None:
        self._writer = NonBlockingWriter(stream)
        self._translate = translate
        self._layout = os.environ.get("RCUTILS_CONSOLE_OUTPUT_FORMAT", LAYOUT)
        colours = stream is not None and wants_colours(stream, os.environ)
        self._tail = LogTail({} if stream is None else logs, self.write, colours)
        self._line = ProgressLine(stream, shows_progress, lambda text: self.log("INFO", text))
        self._is_enough = is_enough
        self._is_finishing = False
        self._patience_s: float | None = None

    def write(self, text: str) -> None:
        """Write as it is, but for the names of paths."""
        self._writer.write(self._line.around(self._translate(text)))
        if self._is_finishing:
            self._writer.finish(self._is_enough, self._patience_s)

    def log(self, severity: str, text: str) -> None:
        """Write a record of the launcher itself, after what nodes have logged so far."""
        self.poll()
        self.write(format_record(severity, "neuros", text, layout=self._layout) + "\n")

    def follow(self, progress: Progress) -> None:
        """Show how far the run has come."""
        self._line.follow(progress)

    def poll(self) -> object:
        """Show what nodes have logged since; it stays in their files while the reader is behind."""
        self._writer.flush()
        if self._writer.is_behind or self._is_finishing:
            return None
        self._writer.write(self._line.update())
        return self._tail.poll()

    def finish(self, patience_s: float | None) -> None:
        """Show the rest; from now on wait for the reader, or lose ``patience_s`` seconds."""
        self._writer.write(self._line.end())
        self._is_finishing = True
        self._patience_s = patience_s
        self.write("")
        self._tail.drain()
