"""Text for people who may read slowly, or not at all: writing never waits for them.

A terminal that was stopped with Ctrl+S, or a pager at the other end of a pipe, takes nothing for
minutes. A launcher that waited for it would miss signals, failures and deadlines. So what does not
go through now is kept, and goes later.
"""

from __future__ import annotations

import contextlib
import os
import select
import time
from collections.abc import Callable
from typing import TextIO

# A pipe that is ready takes this much without blocking (PIPE_BUF, pipe(7)).
_CHUNK_BYTES = 4096
_LOOK_MS = 50


class Screen:
    """A stream that text can be written to without waiting.

    A reader that has gone is no error: the run goes on, and its logs are on disk. A stream without
    a file descriptor (in tests) is written to directly.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self._encoding = "utf-8" if stream is None else stream.encoding or "utf-8"
        self._descriptor = _descriptor(stream)
        self._is_gone = stream is None
        self._unwritten = bytearray()
        self._poll = select.poll()
        if self._descriptor is not None:
            self._poll.register(self._descriptor, select.POLLOUT)

    @property
    def is_behind(self) -> bool:
        """Whether there is text that the reader has not taken."""
        return bool(self._unwritten)

    def write(self, text: str) -> None:
        """Write, now or later."""
        if self._is_gone:
            return
        if self._descriptor is None:
            assert self._stream is not None
            self._stream.write(text)
            return
        self._unwritten += text.encode(self._encoding, "backslashreplace")
        self.flush()

    def flush(self) -> None:
        """Write what the reader takes now."""
        try:
            while self._unwritten and self._poll.poll(0):
                assert self._descriptor is not None
                written = os.write(self._descriptor, self._unwritten[:_CHUNK_BYTES])
                del self._unwritten[:written]
        except BlockingIOError:  # somebody has made it non-blocking; so much the better
            return
        except OSError:
            self._give_up()

    def finish(self, is_enough: Callable[[], bool], patience_s: float | None = None) -> None:
        """Wait until all is written, or until ``is_enough()``.

        ``patience_s`` is how long to wait for a reader that takes nothing, ``None``: for ever.
        """
        last_progress_s, left = time.monotonic(), len(self._unwritten)
        while self._unwritten:
            self.flush()
            if len(self._unwritten) != left:
                last_progress_s, left = time.monotonic(), len(self._unwritten)
            waited_s = time.monotonic() - last_progress_s
            if is_enough() or (patience_s is not None and waited_s > patience_s):
                self._give_up()
            elif self._unwritten:
                self._poll.poll(_LOOK_MS)

    def _give_up(self) -> None:
        self._is_gone = True
        self._unwritten.clear()
        if self._descriptor is not None:
            self._poll.unregister(self._descriptor)


def _descriptor(stream: TextIO | None) -> int | None:
    if stream is None:
        return None
    with contextlib.suppress(OSError, ValueError):
        stream.flush()
    try:
        return stream.fileno()
    except (OSError, ValueError):
        return None
