"""A host: a process that runs nodes.

It leads a session of its own, so that Ctrl+C reaches only the launcher, and writes its log itself,
so that nothing passes through the launcher and nothing is lost when that dies.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from neuros.errors import EnvironmentFault
from neuros.launch.host_command import script_failure
from neuros.launch.placement import Cores, children_on


class HostProcess:
    """A host that was started, and the nodes in it (:class:`neuros.ports.RunningNode`)."""

    def __init__(
        self,
        names: Sequence[str],
        arguments: Sequence[str],
        *,
        log: Path,
        folder: Path,
        environment: Mapping[str, str],
        cores: Cores | None = None,
    ) -> None:
        """Start it in ``folder``, on ``cores``; both its outputs are appended to ``log``.

        Raises ``EnvironmentFault`` if that is impossible.
        """
        self._names = tuple(names)
        self._log = log
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            with open(log, "ab") as output, children_on(cores):
                self._process = subprocess.Popen(
                    list(arguments),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    cwd=folder,
                    env=dict(environment),
                    start_new_session=True,
                )
        except OSError as error:
            nodes = ", ".join(self._names)
            raise EnvironmentFault(f"cannot start the process of {nodes}: {error}") from error

    @property
    def names(self) -> tuple[str, ...]:
        return self._names

    @property
    def pid(self) -> int:
        """Its process id, which is also that of its process group and session."""
        return self._process.pid

    def poll(self) -> str | None:
        """``None`` while it runs, then how it ended, in words."""
        code = self._process.poll()
        if code is None:
            return None
        return (script_failure(self._log) if code == 1 else None) or _in_words(code)

    @property
    def is_abandoned(self) -> bool:
        return False

    def wait(self, timeout_s: float) -> str | None:
        """As :meth:`poll`, after it has ended or ``timeout_s`` seconds have passed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        return self.poll()

    def terminate(self) -> None:
        self._process.terminate()

    def kill(self) -> None:
        """Kill it and its whole process group."""
        # Once it has been reaped, its number may be another's.
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)


def end_now(hosts: Sequence[HostProcess]) -> None:
    """Kill hosts and wait until they are gone."""
    for host in hosts:
        host.kill()
    for host in hosts:
        host.wait(5.0)


def signal_in_words(number: int) -> str:
    """What a signal has done to a process."""
    try:
        return f"killed by {signal.Signals(number).name}"
    except ValueError:  # a real-time signal
        return f"killed by signal {number}"


def _in_words(code: int) -> str:
    return f"exit code {code}" if code >= 0 else signal_in_words(-code)
