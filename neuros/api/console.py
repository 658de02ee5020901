"""Console output of a run: the launcher's records, the log lines of nodes, and the progress."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TextIO

from neuros.backends.console import (
    LAYOUT,
    LogTail,
    NonBlockingWriter,
    Progress,
    format_record,
    wants_colours,
)

_REDRAW_S = 0.5
_PLAIN_S = 10.0
CLEAR = "\r\x1b[K"


class ProgressLine:
    """Shows the progress of a run.

    Args:
        stream: a terminal gets a line that stays below all others.
        is_wanted: ``None``: if it is known when the run ends.
        log: writes a plain record.
    """

    def __init__(
        self, stream: TextIO | None, is_wanted: bool | None, log: Callable[[str], None]
    ) -> None:
        self._is_wanted = is_wanted
        self._log = log
        is_terminal = stream is not None and stream.isatty()
        self._is_line = is_terminal and os.environ.get("TERM") != "dumb"
        self._is_ascii = "utf" not in str(getattr(stream, "encoding", "")).lower()
        self._progress: Progress | None = None
        self._next_s = 0.0
        self._shown = ""

    def follow(self, progress: Progress) -> None:
        """Show this from now on."""
        self._progress = progress
        self._next_s = time.monotonic() + (0.0 if self._is_line else _PLAIN_S)

    def around(self, text: str) -> str:
        """Text as it is to be written while there is a line: above it."""
        return f"{CLEAR}{text}{self._shown}" if self._shown else text

    def update(self) -> str:
        """What is to be written now to draw the line again; plain lines are logged."""
        progress = self._progress
        if progress is None or self._is_wanted is False or time.monotonic() < self._next_s:
            return ""
        if not (self._is_wanted or progress.has_end):
            return ""
        self._next_s = time.monotonic() + (_REDRAW_S if self._is_line else _PLAIN_S)
        if not self._is_line:
            if text := progress.text():
                self._log(text)
            return ""
        columns = shutil.get_terminal_size().columns
        self._shown = progress.bar(columns, is_ascii=self._is_ascii)
        return f"{CLEAR}{self._shown}" if self._shown else ""

    def end(self) -> str:
        """What is to be written to take the line away; nothing is shown any more."""
        self._progress = None
        was_shown, self._shown = bool(self._shown), ""
        return CLEAR if was_shown else ""


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

    @property
    def failure(self) -> OSError | None:
        """Why text was lost, if not because its reader has gone."""
        return self._writer.failure

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
