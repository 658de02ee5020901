"""Filters the output of commands, so that printed text cannot control the terminal.

Names, descriptions, packets, files of robots and errors of plugins come from others.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from typing import Any, TextIO

from neuros.errors import printable

_CLEAR = "\r\x1b[K"
"""Begins each line of progress, which replaces the line before."""


@contextlib.contextmanager
def harmless_output() -> Iterator[None]:
    """Filter all text for the standard streams in this context."""
    streams = sys.stdout, sys.stderr
    filtered: list[Any] = [stream and _Harmless(stream) for stream in streams]
    sys.stdout, sys.stderr = filtered
    try:
        yield
    finally:
        sys.stdout, sys.stderr = streams


class _Harmless:
    """A stream that spells control characters out, and keeps colours where they are wanted."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        length = len(text)
        if "\x1b" in text and self._stream.isatty() and text.startswith(_CLEAR):
            self._stream.write(_CLEAR)
            text = text[len(_CLEAR) :]
        keeps_colours = False
        if "\x1b" in text:
            from neuros.backends.console import wants_colours

            keeps_colours = wants_colours(self._stream, os.environ)
        self._stream.write(printable(text, keeps_colours=keeps_colours))
        return length

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
