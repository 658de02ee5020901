"""Two processes behind a Rerun viewer: its server, and the feed from a run."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from neuros.backends.child_processes import start_sidecar

HOST = "127.0.0.1"
_MEMORY = "512MB"
_END_S = 3.0
_START_S, _LOOK_S = 30.0, 0.1


class RerunProcesses:
    """Serves a Rerun web viewer for a run.

    Attributes:
        feed_url: where marks are sent to.
        url: the address to open in a browser.
    """

    def __init__(self) -> None:
        self._feed_port, self._web_port = _free_ports(2)
        self.feed_url = f"rerun+http://{HOST}:{self._feed_port}/proxy"
        self.url = f"http://{HOST}:{self._web_port}/?url={quote(self.feed_url, safe=':/')}"
        self._processes: list[subprocess.Popen[bytes]] = []

    def start(
        self,
        feeder: Sequence[str],
        run: Path,
        environment: Mapping[str, str],
        told: Mapping[str, Any],
    ) -> list[int]:
        """Start both, once there is a control socket; returns their ids.

        Args:
            feeder: the command of what feeds it, which is ``told`` the rest on its input.

        Raises:
            EnvironmentFault: if one of them cannot be started.
        """
        server = [sys.executable, "-m", "rerun", "--serve-web", "--bind", HOST]
        server += ["--port", str(self._feed_port), "--web-viewer-port", str(self._web_port)]
        server += ["--server-memory-limit", _MEMORY, "--hide-welcome-screen"]
        server += ["--newest-first"]  # who opens it late wants to see what is now
        log = run / "rerun.log"
        for what, command in (("server of Rerun", server), ("feeder of Rerun", feeder)):
            self._processes.append(start_sidecar(what, command, run, log, environment))
        pipe = self._processes[-1].stdin
        assert pipe is not None
        with contextlib.suppress(BrokenPipeError), pipe:
            text = json.dumps({**told, "feed_url": self.feed_url, "url": self.url})
            pipe.write(text.encode() + b"\n")
        return [process.pid for process in self._processes]

    def finish(self) -> None:
        """End them with the run: the feeder by itself, then the server."""
        for process in reversed(self._processes):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_END_S if process is self._processes[-1] else 0)
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()


def await_server(url: str) -> None:
    """Until the server of a page answers. Raises ``OSError`` if it does not."""
    where = urlsplit(url)
    give_up_s = time.monotonic() + _START_S
    while True:
        try:
            socket.create_connection((HOST, where.port or 0), 1.0).close()
        except ConnectionRefusedError:
            if time.monotonic() > give_up_s:
                raise
            time.sleep(_LOOK_S)
        else:
            return


def _free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind((HOST, 0))
        return [each.getsockname()[1] for each in sockets]
