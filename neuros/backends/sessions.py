"""Runs on this machine that this user may see: its own, or all for root.

Each run has a mark, a file in ``/dev/shm`` that describes it and that only its user can read. The
launcher and the guardian of the run have the file locked (``flock``) from before the first process
of the run until after the last, so a mark that is left by a killed run is not taken for a run.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import signal
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from neuros.backends.console import clean
from neuros.backends.control_sockets import connect
from neuros.backends.domain import FileLock
from neuros.backends.run_processes import RunProcesses, started_at
from neuros.backends.shared_memory import MARK, read_if_held
from neuros.control import TO_OBSERVERS, Interrupt, Watch
from neuros.control.link import ControlLink, read_as, with_texts
from neuros.errors import ControlError, EnvironmentFault

_FOLDER = Path("/dev/shm")


@dataclass(frozen=True)
class RunOnThisMachine:
    """A run, described by its launcher.

    Attributes:
        run: its id.
        folder: the run folder.
        namespace: of its nodes on the ROS graph, empty or as in ``/left``.
        is_one_process: whether its nodes share a process.
        since: Unix time, in seconds.
        launcher: process id and start (clock ticks since boot): a later process may have the
            same number.
        control: address of its control channel.
        elsewhere: the machine of each node that runs on another one.
        user: number of the user, which is that of the mark's owner.
    """

    run: str
    project: str
    backend: str
    nodes: tuple[str, ...]
    folder: str
    since: float
    launcher: tuple[int, int]
    namespace: str = ""
    is_one_process: bool = False
    control: str = ""
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    user: int = field(default_factory=os.getuid)

    @property
    def is_own(self) -> bool:
        """Whether it is a run of the user who asks."""
        return self.user == os.getuid()

    @property
    def is_led(self) -> bool:
        """Whether its launcher runs; if not, the guardian is ending the run."""
        pid, start = self.launcher
        return started_at(pid) == start and _user_of(pid) == self.user

    def states(self) -> Mapping[str, str]:
        """The state of each node: running, ending (its launcher has gone), or not running."""
        processes = RunProcesses(self.run)
        there = set(processes.nodes().values())
        if self.is_one_process and processes.alive():
            there = set(self.nodes)
        up = "running" if self.is_led else "ending"
        there.update(self.elsewhere)  # a run ends if its launcher loses one of them
        return {node: up if node in there else "not running" for node in self.nodes}

    def interrupt(self) -> None:
        """Ask its launcher to end it, as Ctrl+C does.

        The request goes over the control channel, since the launcher may be a Python program with
        other work; a signal does where there is no channel yet.
        """
        if not self.is_led:
            return
        try:
            link = ControlLink(connect(self.control), TO_OBSERVERS, "the supervisor")
        except (OSError, EnvironmentFault):
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.launcher[0], signal.SIGINT)
        else:
            link.send(Watch())  # requests count after a greeting
            link.send(Interrupt())
            link.close()


def mark(session: RunOnThisMachine) -> FileLock:
    """Make the mark of a run; without shared memory there is none, and ``neuros ps`` shows none."""
    path = _FOLDER / f"neuros_{session.run}{MARK}"
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except OSError:
        return FileLock()
    fcntl.flock(descriptor, fcntl.LOCK_SH)
    with contextlib.suppress(OSError), open(descriptor, "w", closefd=False) as file:
        json.dump(asdict(session), file)
    return FileLock((path, descriptor))


def this_process() -> tuple[int, int]:
    """Process id and start of this process, in clock ticks since boot."""
    return os.getpid(), started_at(os.getpid()) or 0


def sessions() -> list[RunOnThisMachine]:
    """All runs of this user, for root also those of others; oldest first."""
    return sorted(_found(), key=lambda session: session.since)


def _found() -> Iterator[RunOnThisMachine]:
    for path in _FOLDER.glob(f"neuros_*{MARK}"):
        # Another version of NeuROS, or another user, may have written anything there, control
        # sequences of terminals too.
        with contextlib.suppress(OSError, ControlError, ValueError, TypeError, RecursionError):
            described = json.loads(read_if_held(path) or b"")
            described |= {"user": path.lstat().st_uid}
            described = with_texts(described, lambda text: clean(text, keep_colours=False))
            yield read_as(RunOnThisMachine, described)


def _user_of(pid: int) -> int | None:
    """The number of the user of a process, ``None`` if it has ended."""
    try:
        return os.stat(f"/proc/{pid}").st_uid
    except FileNotFoundError:
        return None
