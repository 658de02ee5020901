"""Sidecar processes: the recorder, the dashboard and the Rerun viewer of a run.

Each is started before the nodes or beside them, and ended after them.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from neuros.backends.node_command import process_environment, with_libraries
from neuros.errors import EnvironmentFault, UsageError

HOST = "127.0.0.1"
END = b"end\n"
"""What the recorder is told when nothing more will come."""

_NICENESS = 10
_RERUN_MEMORY = "512MB"
_END_S = 3.0
_START_S, _LOOK_S = 30.0, 0.1


def start_sidecar(
    what: str,
    command: Sequence[str],
    run: Path,
    log: Path,
    environment: Mapping[str, str],
    pass_fds: Sequence[int] = (),
    *,
    is_ours: bool = True,
) -> subprocess.Popen[bytes]:
    """Start a program in the run folder, in a session of its own, at lower priority than nodes.

    Args:
        what: its name, for messages.
        log: where its standard error goes; input and output are pipes.
        environment: what is added to that of this process.
        is_ours: whether it is a program of this Python; others do not get the libraries of ours.

    Raises:
        EnvironmentFault: if it cannot be started.
    """
    whole = process_environment(os.environ, environment)
    try:
        with open(log, "ab") as file:
            process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                cwd=run,
                env=with_libraries(whole) if is_ours else whole,
                start_new_session=True,
                pass_fds=tuple(pass_fds),
            )
    except OSError as error:
        raise EnvironmentFault(f"the {what} cannot be started: {error}") from error
    with contextlib.suppress(OSError):  # it has a lower one already, which only root may raise
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
    return process


@dataclass
class Recorded:
    """Last report of a recorder: packets by topic, and problems, a sentence each."""

    counts: dict[str, int] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


class RecorderProcess:
    """Runs the recorder of a run.

    Args:
        command: the program; started again, it completes what it has left before.
        environment: what is added to that of this process.

    Raises:
        EnvironmentFault: if it cannot be started.
    """

    def __init__(
        self, command: Sequence[str], run: Path, log: Path, environment: Mapping[str, str]
    ) -> None:
        self._command = list(command)
        self._run = run
        self._log = log
        self._environment = environment
        self._process = self._start()

    @property
    def pid(self) -> int:
        """Its process id; it leads a session of its own."""
        return self._process.pid

    def finish(self, is_given_up: Callable[[], bool]) -> Recorded:
        """Have it put the last packets into the bag, however long that takes.

        Args:
            is_given_up: asked again and again whether the user gives up waiting.
        """
        recorded = self._finish(is_given_up)
        if recorded is None and not is_given_up():  # killed, or it has failed
            self._process = self._start()
            recorded = self._finish(is_given_up)
        if recorded is None:
            why = "it was not waited for" if is_given_up() else f"see {self._log}"
            recorded = Recorded(
                problems=[
                    f"the bag is not complete ({why}): neuros bag repair {self._run} completes it"
                ]
            )
        return recorded

    def _start(self) -> subprocess.Popen[bytes]:
        # The nodes come first: what the recorder has not got to waits for it on the disk.
        return start_sidecar("recorder", self._command, self._run, self._log, self._environment)

    def _finish(self, is_given_up: Callable[[], bool]) -> Recorded | None:
        """Its last report, ``None`` if it makes none."""
        told: bytes | None = END
        while True:
            try:
                answer, _ = self._process.communicate(told, _LOOK_S)
                break
            except subprocess.TimeoutExpired:
                told = None
                if is_given_up():
                    self._process.kill()
        try:
            return Recorded(**json.loads(answer))
        except (ValueError, TypeError):
            return None


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
        server += ["--server-memory-limit", _RERUN_MEMORY, "--hide-welcome-screen"]
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
