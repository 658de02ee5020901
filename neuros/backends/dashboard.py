"""The dashboard process of a run: started before its nodes, ended after them."""

from __future__ import annotations

import contextlib
import json
import secrets
import socket
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.backends.child_processes import start_sidecar
from neuros.errors import UsageError

HOST = "127.0.0.1"
_END_S = 3.0


class DashboardProcess:
    """Serves the dashboard of a run.

    It listens as soon as this is made, so the address may be opened at once; requests wait until
    the process is started, which loads what it needs when the first one comes. It ends when the
    supervisor hangs up, or, if no page was open, with its standard input.

    Args:
        port: on 127.0.0.1; 0: any free one.

    Raises:
        UsageError: if the port is taken.
    """

    def __init__(self, port: int) -> None:
        self._token = secrets.token_urlsafe(24)
        self._process: subprocess.Popen[bytes] | None = None
        self._listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listening.bind((HOST, port))
        except (OSError, OverflowError) as error:
            self._listening.close()
            raise UsageError(
                f"--dashboard-port {port}: cannot be listened on ({error}); name another one, or"
                " leave it out for any free one"
            ) from error
        self._listening.listen(64)
        self._port = self._listening.getsockname()[1]

    @property
    def url(self) -> str:
        """The address to open, with the token that lets the reader in."""
        return f"http://{HOST}:{self._port}/?token={self._token}"

    def start(
        self,
        command: Sequence[str],
        run: Path,
        environment: Mapping[str, str],
        told: Mapping[str, Any],
    ) -> int:
        """Start the process, once there is a control socket; returns its id.

        Args:
            told: what it is told on its standard input, besides the token and where to listen:
                a command line can be read by other users.

        Raises:
            EnvironmentFault: if it cannot be started.
        """
        descriptor = self._listening.fileno()
        self._process = process = start_sidecar(
            "dashboard", command, run, run / "dashboard.log", environment, [descriptor]
        )
        self._listening.close()
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            text = json.dumps({**told, "token": self._token, "descriptor": descriptor})
            process.stdin.write(text.encode() + b"\n")
            process.stdin.flush()
        return process.pid

    def finish(self) -> None:
        """Let it tell its pages that the run is over, and end."""
        self._listening.close()
        process = self._process
        if process is None:
            return
        if process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
