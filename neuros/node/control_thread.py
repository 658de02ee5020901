"""The thread that reports to the supervisor and obeys it while hooks run."""

from __future__ import annotations

import contextlib
import selectors
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from neuros.control import Lines

REPORT_S = 1.0


class Controlled(Protocol):
    """A process of nodes, as the supervisor commands it."""

    def post(self, event: Callable[[], None]) -> None: ...
    def ask_to_stop(self) -> None: ...
    def drain(self, last_round: Mapping[str, Sequence[int]]) -> None: ...
    def pause(self) -> None: ...
    def resume(self) -> None: ...
    def step(self, count: int, *, is_driven: bool) -> None: ...
    def look(self, wanted: Mapping[str, Any], asker: int) -> None: ...
    def probe(self, number: int) -> None: ...
    def report(self) -> None: ...
    def explain(self) -> None: ...
    def say(self, text: str) -> None: ...
    def leave(self) -> None: ...


class ControlThread(threading.Thread):
    """Reports once per second and passes on what the supervisor asks for.

    A supervisor that has gone, and a signal, both mean: stop. What fails here (a simulator whose
    time cannot be read, say) fails again in the loop, which knows what to do about it.
    """

    def __init__(self, lines: Lines, signalled: socket.socket, process: Controlled) -> None:
        super().__init__(name="neuros-control", daemon=True)
        self._lines = lines
        self._signalled = signalled
        self._process = process
        self._ended = threading.Event()

    def run(self) -> None:
        """Until the supervisor hangs up or :meth:`end`."""
        next_report_s = time.monotonic() + REPORT_S
        with selectors.DefaultSelector() as selector:
            selector.register(self._lines, selectors.EVENT_READ)
            selector.register(self._signalled, selectors.EVENT_READ)
            while not self._ended.is_set():
                for key, _ in selector.select(max(0.0, next_report_s - time.monotonic())):
                    if key.fileobj is self._signalled:
                        self._on_signal()
                    elif not self._on_lines():
                        return
                if time.monotonic() >= next_report_s and not self._ended.is_set():
                    next_report_s = time.monotonic() + REPORT_S
                    self._try(self._process.report)

    def end(self) -> None:
        """Report no more."""
        self._ended.set()

    def _on_signal(self) -> None:
        try:
            self._signalled.recv(64)
        except OSError:
            return
        self._process.ask_to_stop()

    def _on_lines(self) -> bool:
        messages = self._lines.receive()
        if messages is None:
            self._process.ask_to_stop()
            self._process.leave()
            return False
        for message in messages:
            self._obey(message)
        return True

    def _obey(self, message: Mapping[str, Any]) -> None:
        process, kind = self._process, message["kind"]
        if kind == "stop":
            process.ask_to_stop()
        elif kind == "drain":
            last_round = message["last_round"]
            process.post(lambda: process.drain(last_round))
        elif kind == "probe":
            number = int(message["number"])
            process.post(lambda: process.probe(number))
        elif kind == "pause":
            process.post(process.pause)
        elif kind == "resume":
            process.post(process.resume)
        elif kind == "step":
            count, is_driven = int(message["count"]), bool(message["is_driven"])
            process.post(lambda: process.step(count, is_driven=is_driven))
        elif kind == "look":
            self._try(lambda: process.look(message["wanted"], int(message["asker"])))
        elif kind == "explain":
            self._try(process.explain)
        elif kind == "say":
            self._try(lambda: process.say(str(message["text"])))
        elif kind == "leave":
            process.leave()

    def _try(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:
            self._process.post(lambda error=error: _raise(error))  # type: ignore[misc]


def _raise(error: Exception) -> None:
    raise error


@contextlib.contextmanager
def signals_as_socket() -> Iterator[socket.socket]:
    """A socket that becomes readable on SIGTERM or SIGINT, also during a wait in C++."""
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    reader.setblocking(False)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    previous = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    try:
        yield reader
    finally:
        signal.set_wakeup_fd(previous)
        reader.close()
        writer.close()
