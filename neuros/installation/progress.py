"""Progress lines for a terminal or a log file."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Protocol

_QUIET_S = 10.0


class Stream(Protocol):
    """Output of progress: a text file, or an object with these methods."""

    def isatty(self) -> bool: ...
    def write(self, text: str, /) -> object: ...
    def flush(self) -> object: ...


class Progress:
    """One line per step, with the time since the start; on a terminal, details in place."""

    def __init__(self, stream: Stream) -> None:
        self._stream, self._is_terminal = stream, stream.isatty()
        self._start = self._last = time.monotonic()

    def step(self, text: str) -> None:
        self._last = time.monotonic()
        self._write(f"{self._line(text)}\n")

    def detail(self, text: str) -> None:
        """Show that something moves: at once on a terminal, else after ten quiet seconds."""
        if self._is_terminal:
            width = shutil.get_terminal_size().columns - 1
            self._write(self._line(f"  {text}")[:width])
        elif time.monotonic() - self._last >= _QUIET_S:
            self.step(f"  {text}")

    def fail(self, text: str) -> None:
        """Show the error that ended the work."""
        self._write(f"{text}\n")

    def _line(self, text: str) -> str:
        return f"[{time.monotonic() - self._start:6.1f} s] {text}"

    def _write(self, text: str) -> None:
        clear = "\r\x1b[K" if self._is_terminal else ""
        self._stream.write(clear + text)
        self._stream.flush()


def run_logged(
    command: Sequence[str],
    log: Path,
    show: Callable[[str], object],
    *,
    environ: Mapping[str, str],
    folder: Path | None = None,
    given: IO[bytes] | None = None,
) -> int:
    """Run a program, append its output to a log, and show each line; returns its exit code.

    ``given`` is its standard input. Raises ``OSError``: if it cannot be started, or the log not
    written.
    """
    with (
        log.open("a", encoding="utf-8") as file,
        subprocess.Popen(
            command,
            cwd=folder,
            env=environ,
            stdin=given or subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
        ) as program,
    ):
        try:
            for line in program.stdout or ():
                file.write(line)
                show(line)
        except BaseException:  # Ctrl+C, above all
            program.terminate()
            raise
    return program.returncode
