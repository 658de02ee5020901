"""Where the progress of a run is shown: a line that stays, or plain lines now and then."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from typing import TextIO

from neuros.launch.progress import Progress

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
