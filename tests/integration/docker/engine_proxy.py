"""Stands between a client and the Docker engine, so that a test can take the engine away."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import tempfile
import threading
from types import TracebackType


class EngineProxy:
    """A Unix socket that passes everything on to another one, until :meth:`close`.

    Attributes:
        path: of the socket.
    """

    def __init__(self, engine: str) -> None:
        self._engine = engine
        self._folder = tempfile.mkdtemp(prefix="neuros-proxy-")
        self.path = os.path.join(self._folder, "docker.sock")
        self._ends: list[socket.socket] = []
        self._listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listening.bind(self.path)
        self._listening.listen()
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def close(self) -> None:
        """Go away, as an engine does that ends; a second call has no effect."""
        shutil.rmtree(self._folder, ignore_errors=True)
        for end in (self._listening, *self._ends):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for end in (self._listening, *self._ends):
            end.close()

    def __enter__(self) -> EngineProxy:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listening.accept()
                engine = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
                self._ends += [client, engine]
                engine.connect(self._engine)
                for source, target in ((client, engine), (engine, client)):
                    thread = threading.Thread(target=_pass_on, args=(source, target))
                    self._threads.append(thread)
                    thread.start()


def _pass_on(source: socket.socket, target: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(1 << 16):
            target.sendall(data)
        target.shutdown(socket.SHUT_WR)
