"""Sidecar processes: the recorder of a run, and programs of viewers.

Each is started before the nodes or beside them, and ended after them.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from neuros.backends.node_command import process_environment, with_libraries
from neuros.errors import EnvironmentFault

END = b"end\n"
"""Tells the recorder that no more packets come."""

_NICENESS = 10
_POLL_S = 0.1


def start_sidecar(
    what: str,
    command: Sequence[str],
    log: Path,
    environment: Mapping[str, str],
    pass_fds: Sequence[int] = (),
    *,
    is_ours: bool = True,
) -> subprocess.Popen[bytes]:
    """Start a program beside a run, in a session of its own, at lower priority than nodes.

    Its current folder is ``/``: nodes may write to the run folder, and Python may import from the
    current folder.

    Args:
        what: its name, for messages.
        log: receives its standard error; input and output are pipes.
        environment: is added to that of this process.
        is_ours: whether this Python runs it, with its libraries.

    Raises:
        EnvironmentFault: if it cannot be started.
    """
    whole = process_environment(os.environ, environment)
    try:
        with log.open("ab") as file:
            process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                cwd="/",
                env=with_libraries(whole) if is_ours else whole,
                start_new_session=True,
                pass_fds=tuple(pass_fds),
            )
    except OSError as error:
        raise EnvironmentFault(f"the {what} cannot be started: {error}") from error
    with contextlib.suppress(OSError):  # only root may raise a lower priority
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
        command: the program; a second start completes the bag of the first.
        environment: is added to that of this process.

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

    def finish(self, is_given_up: Callable[[], bool]) -> Recorded:
        """Wait until the last packets are in the bag.

        Args:
            is_given_up: tells whether the user gives up waiting.
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
        # Nodes have priority: packets wait for the recorder on the disk.
        return start_sidecar("recorder", self._command, self._log, self._environment)

    def _finish(self, is_given_up: Callable[[], bool]) -> Recorded | None:
        """Its last report, ``None`` without one."""
        told: bytes | None = END
        while True:
            try:
                answer, _ = self._process.communicate(told, _POLL_S)
                break
            except subprocess.TimeoutExpired:
                told = None
                if is_given_up():
                    self._process.kill()
        try:
            return Recorded(**json.loads(answer))
        except (ValueError, TypeError):
            return None
