"""Child processes of a launcher: node processes, and sidecar processes beside them.

A node process runs one node, or all. It leads a session of its own, so that Ctrl+C reaches only
the launcher, and writes its log itself, so that nothing passes through the launcher and nothing is
lost when that dies.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from neuros.backends.node_command import (
    NodeProcess,
    process_environment,
    script_failure,
    with_libraries,
)
from neuros.backends.placement import children_on
from neuros.errors import EnvironmentFault

_NICENESS = 10


class RunningProcess:
    """A node process that was started, and the nodes in it (:class:`neuros.ports.RunningNode`)."""

    def __init__(self, process: NodeProcess) -> None:
        """Start it; raises ``EnvironmentFault`` if that is impossible."""
        self._names = process.names
        self._log = process.log
        try:
            process.log.parent.mkdir(parents=True, exist_ok=True)
            with open(process.log, "ab") as output, children_on(process.cores):
                self._process = subprocess.Popen(
                    process.command,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    cwd=process.folder,
                    env=process.environment,
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


def end_now(processes: Sequence[RunningProcess]) -> None:
    """Kill processes and wait until they are gone."""
    for process in processes:
        process.kill()
    for process in processes:
        process.wait(5.0)


def signal_in_words(number: int) -> str:
    """The effect of a signal on a process, in words."""
    try:
        return f"killed by {signal.Signals(number).name}"
    except ValueError:  # a real-time signal
        return f"killed by signal {number}"


def _in_words(code: int) -> str:
    return f"exit code {code}" if code >= 0 else signal_in_words(-code)


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
    os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
    return process
