"""Feed of the drawing process: messages that it cannot take now are kept, and left out at last.

No thread, and nothing that waits: a message goes into the socket as far as it takes it, the rest
with the next one.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neuros.errors import EnvironmentFault

_MOST_UNSENT_BYTES = 1 << 22
_NICENESS = 5
_PATIENCE_S = 30.0
# A node has 5 s in all to end.
_PATIENCE_AT_END_S = 4.0
_LENGTH = struct.Struct("!I")
# The program needs no ROS: it must not start a second time to find its libraries.
_ENVIRONMENT = {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}


class Feed:
    """The drawing process of one figure, and the way to it.

    Args:
        first: the first message.
        file: where the figure is saved.

    Attributes:
        dropped: messages that were left out.

    Raises:
        EnvironmentFault: if it cannot be started.
    """

    def __init__(self, first: Sequence[Any], file: Path) -> None:
        self.file = file
        self.dropped = 0
        self._sent = 0
        self._unsent = bytearray()
        self._latest: dict[str, Sequence[Any]] = {}
        self._is_gone = False
        self._socket, far_end = socket.socketpair()
        self._socket.setblocking(False)
        try:
            self._process: subprocess.Popen[bytes] = subprocess.Popen(
                [sys.executable, "-m", "neuros.visualise.program"],
                stdin=far_end.fileno(),
                env={**os.environ, **_ENVIRONMENT},
            )
        except OSError as error:
            self._socket.close()
            raise EnvironmentFault(f"the drawing process cannot be started: {error}") from error
        finally:
            far_end.close()
        with contextlib.suppress(OSError):  # the node comes first
            os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICENESS)
        _OPEN.append(self)
        self.send(first)

    @property
    def pid(self) -> int:
        """The process id of the drawing process."""
        return self._process.pid

    def send(self, message: Sequence[Any]) -> None:
        """Have something drawn, or leave it out."""
        self._flush()
        if self._is_gone or len(self._unsent) > _MOST_UNSENT_BYTES:
            self.dropped += 1
            return
        self._add(message)
        self._flush()

    def send_latest(self, name: str, message: Sequence[Any]) -> None:
        """Have something drawn in the place of what was to be drawn under that name before."""
        self.dropped += self._is_gone or name in self._latest
        self._latest[name] = message
        self._flush()

    def close(self) -> None:
        """Let it draw the rest, save and end; wait for that some seconds. May be called again."""
        _close([self], _PATIENCE_S)

    def hang_up(self, deadline_s: float) -> None:
        """Send the rest, and say that there will be no more."""
        while self._has_more and time.monotonic() < deadline_s:
            select.select([], [self._socket], [], 0.1)
            self._flush()
        self._socket.close()

    def wait(self, deadline_s: float) -> None:
        """Until the process has ended."""
        try:
            self._process.wait(max(0.1, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            print(
                "a figure could not be drawn in time, and was not saved at the end", file=sys.stderr
            )
        if self.dropped:
            count = self.dropped + self._sent
            print(f"{self.dropped} of {count} updates were not drawn", file=sys.stderr)

    @property
    def _has_more(self) -> bool:
        return not self._is_gone and bool(self._unsent or self._latest)

    def _add(self, message: Sequence[Any]) -> None:
        data = pickle.dumps(tuple(message), pickle.HIGHEST_PROTOCOL)
        self._unsent += _LENGTH.pack(len(data)) + data
        self._sent += 1

    def _flush(self) -> None:
        try:
            while self._has_more:
                if not self._unsent:
                    self._add(self._latest.pop(next(iter(self._latest))))
                sent = self._socket.send(self._unsent, socket.MSG_NOSIGNAL)
                del self._unsent[:sent]
        except BlockingIOError:
            return
        except OSError:  # it has ended, and has said why
            self._is_gone = True


_OPEN: list[Feed] = []


def is_drawn(file: Path) -> bool:
    """Whether a figure of this process is saved there."""
    return any(feed.file == file for feed in _OPEN)


def _close(feeds: Sequence[Feed], patience_s: float) -> None:
    """Let them end side by side."""
    deadline_s = time.monotonic() + patience_s
    closing = [feed for feed in feeds if feed in _OPEN]
    for feed in closing:
        _OPEN.remove(feed)
        feed.hang_up(deadline_s)
    for feed in closing:
        feed.wait(deadline_s)


@atexit.register
def _close_all() -> None:
    """The process of the node ends; its figures are saved before."""
    _close(tuple(_OPEN), _PATIENCE_AT_END_S)
