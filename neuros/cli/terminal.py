"""What commands print does nothing to the terminal that it may go to.

Names, descriptions, packets, files of robots and errors of plugins hold what somebody else wrote.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from typing import Any, TextIO

from neuros.errors import printable

_CLEAR = "\r\x1b[K"
"""What our own progress begins with, to take the place of the line before."""


@contextlib.contextmanager
def harmless_output() -> Iterator[None]:
    """In the block, all text of this process for its standard streams is filtered."""
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(_harmless, streams)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = streams


def _harmless(stream: TextIO) -> Any:
    return stream if stream is None else _Harmless(stream)


class _Harmless:
    """A stream that spells control characters out, but colours where there are to be some."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        length = len(text)
        if "\x1b" in text and self._stream.isatty() and text.startswith(_CLEAR):
            self._stream.write(_CLEAR)
            text = text[len(_CLEAR) :]
        has_colours = "\x1b" in text and self._has_colours
        self._stream.write(printable(text, keeps_colours=has_colours))
        return length

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    @property
    def _has_colours(self) -> bool:
        from neuros.backends.console import wants_colours

        return wants_colours(self._stream, os.environ)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
