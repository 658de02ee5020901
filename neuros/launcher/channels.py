"""The supervisor's ends of the control channel, one per process of nodes.

Nothing here ever waits for a node: one that is stopped, or has forked children which keep its
socket open, must not hold up the supervisor.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from neuros.control import Lines, encode_line, listen
from neuros.errors import EnvironmentFault

_MOST_UNSENT_BYTES = 1 << 20
_READS_AT_A_TIME = 64
_WAKING_BYTES = 1024


class Channels:
    """Everybody that has connected to the control socket of a run.

    Raises:
        EnvironmentFault: if there can be no such socket in ``run_folder``.
    """

    def __init__(self, run_folder: Path) -> None:
        try:
            self._listening = listen(run_folder)
        except OSError as error:
            raise EnvironmentFault(
                f"{run_folder}: cannot make the control socket there ({error.strerror}): is the"
                " folder used by another run, or on a file system without sockets? Name another"
                " one with -o"
            ) from error
        self._listening.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listening, selectors.EVENT_READ)
        self._ends: dict[Lines, bytearray] = {}
        self._waker: socket.socket | None = None

    def wake_on(self, waker: socket.socket) -> None:
        """Let :meth:`wait` return, too, when bytes arrive here; they mean nothing by themselves."""
        waker.setblocking(False)
        self._waker = waker
        self._selector.register(waker, selectors.EVENT_READ)

    def wait(self, timeout_s: float) -> None:
        """Until something arrives, ``timeout_s`` at most."""
        self._selector.select(timeout_s)
        if self._waker is not None:
            with contextlib.suppress(BlockingIOError):
                while self._waker.recv(_WAKING_BYTES) != b"":
                    pass

    def receive(self) -> Iterator[tuple[Lines, Mapping[str, Any]]]:
        """All that has arrived. What a process sent before it ended is there when it has ended."""
        self._accept()
        for lines in tuple(self._ends):
            for _ in range(_READS_AT_A_TIME):
                has_more, messages = _read(lines)
                yield from ((lines, message) for message in messages)
                if has_more is None:
                    self._forget(lines)
                if not has_more:
                    break

    def send(self, kind: str, **fields: Any) -> None:
        """Send to all."""
        for lines in tuple(self._ends):
            self.send_to(lines, kind, **fields)

    def send_to(self, lines: Lines, kind: str, **fields: Any) -> None:
        """Send to one; what does not go through now goes with the next, or :meth:`flush`."""
        if lines in self._ends and len(self._ends[lines]) < _MOST_UNSENT_BYTES:
            self._ends[lines] += encode_line(kind, fields)
            self._flush(lines)

    def has(self, lines: Lines) -> bool:
        """Whether that one is still connected."""
        return lines in self._ends

    def flush(self) -> None:
        """Try again to send what did not go through."""
        for lines, unsent in tuple(self._ends.items()):
            if unsent:
                self._flush(lines)

    def close(self) -> None:
        """Hang up."""
        for lines in tuple(self._ends):
            self._forget(lines)
        self._selector.close()
        self._listening.close()

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                connected, _ = self._listening.accept()
                connected.setblocking(False)
                lines = Lines(connected)
                self._ends[lines] = bytearray()
                self._selector.register(lines, selectors.EVENT_READ)

    def _flush(self, lines: Lines) -> None:
        unsent = self._ends[lines]
        # An error shows again, and is dealt with, when we read.
        with contextlib.suppress(OSError):
            while unsent:
                sent = lines.socket.send(unsent, socket.MSG_NOSIGNAL)
                del unsent[:sent]

    def _forget(self, lines: Lines) -> None:
        self._selector.unregister(lines)
        del self._ends[lines]
        lines.close()


def _read(lines: Lines) -> tuple[bool | None, list[Mapping[str, Any]]]:
    """One read: whether there may be more (``None``: it has hung up), and what came."""
    try:
        messages = lines.receive_now()
    except BlockingIOError:
        return False, []
    except ValueError:  # that is none of ours
        return None, []
    return (None, []) if messages is None else (True, messages)
