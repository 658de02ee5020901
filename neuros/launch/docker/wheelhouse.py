"""A folder of wheels for builds without a package index.

The classic builder has no mounts, and what is copied into an image stays in its layers. So pip gets
the wheels over HTTP from this machine, while the build uses this machine's network; only programs
of this machine reach the server.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

from neuros.errors import EnvironmentFault


class _Handler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Nobody wants to know."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve the wheels in a folder as long as the context lasts; yields the address.

    Raises:
        EnvironmentFault: if there are no wheels.
    """
    if not any(folder.glob("*.whl")):
        raise EnvironmentFault(f"--wheelhouse {folder}: there are no wheels (*.whl) in this folder")
    server = _server(folder)
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _server(folder: Path) -> ThreadingHTTPServer:
    """At the same port for the same folder, if that is free: the builder caches by address."""
    handler = partial(_Handler, directory=str(folder))
    try:
        port = 20000 + zlib.crc32(bytes(folder.resolve())) % 10000
        return ThreadingHTTPServer(("127.0.0.1", port), handler)
    except OSError:
        return ThreadingHTTPServer(("127.0.0.1", 0), handler)
