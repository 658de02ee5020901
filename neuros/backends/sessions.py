"""Runs on this machine that this user may see: its own, or all for root.

Each run has a reaper from before its first process until after its last: where a reaper is,
there is a run. So nothing is written down that could be out of date; what the reaper guards
stands in its environment, which only its user can read.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from neuros.backends.console import clean
from neuros.backends.control_sockets import connect
from neuros.backends.run_processes import RunProcesses, environ_of, started_at
from neuros.control import TO_OBSERVERS, Interrupt, Watch
from neuros.control.link import ControlLink, read_as
from neuros.errors import ControlError, EnvironmentFault

_VARIABLE = "NEUROS_GUARDED_RUN"


@dataclass(frozen=True)
class Session:
    """A run, as its launcher described it.

    Attributes:
        run: its id.
        folder: the run folder.
        namespace: of its nodes on the ROS graph, empty or as in ``/left``.
        is_one_process: whether its nodes share a process.
        since: Unix time, in seconds.
        launcher: process id, and when that process started (clock ticks since boot): later
            processes may have the same number.
        control: address of its control channel.
        elsewhere: the machine of each node that runs on another one.
        user: number of the user whose run it is: that of its reaper, whatever that says.
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
        """Whether its launcher is there; if not, the reaper is about to end it."""
        pid, start = self.launcher
        return started_at(pid) == start and _user_of(pid) == self.user

    def states(self) -> Mapping[str, str]:
        """The state of each node: running, ending (its launcher has gone), or not running."""
        processes = RunProcesses(self.run)
        there = set(processes.nodes().values())
        if self.is_one_process and processes.alive():
            there = set(self.nodes)
        up = "running" if self.is_led else "ending"
        there.update(self.elsewhere)  # a run whose launcher does not hear of one of them ends
        return {node: up if node in there else "not running" for node in self.nodes}

    def interrupt(self) -> None:
        """Ask its launcher to end it, as Ctrl+C does.

        Over its control channel: where a Python program has started it, a signal would reach that
        program, which may do something else meanwhile. A signal where there is no channel yet.
        """
        if not self.is_led:
            return
        try:
            link = ControlLink(connect(self.control), TO_OBSERVERS, "the supervisor")
        except (OSError, EnvironmentFault):
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.launcher[0], signal.SIGINT)
        else:
            link.send(Watch())  # what observers ask for is heard of those that have greeted
            link.send(Interrupt())
            link.close()


def reaper_environment(session: Session) -> dict[str, str]:
    """Environment that marks a reaper as that of a run."""
    return {_VARIABLE: json.dumps(asdict(session))}


def this_process() -> tuple[int, int]:
    """The number of this process, and when it started."""
    return os.getpid(), started_at(os.getpid()) or 0


def sessions() -> list[Session]:
    """All runs of this user, for root also those of others; oldest first."""
    return sorted(_found(), key=lambda session: session.since)


def _found() -> Iterator[Session]:
    mark = f"{_VARIABLE}=".encode()
    for name in filter(str.isdigit, os.listdir("/proc")):
        for variable in environ_of(int(name)):
            if variable.startswith(mark):
                # Another version of NeuROS, or another user, may have written anything there.
                with contextlib.suppress(ControlError, ValueError, TypeError, RecursionError):
                    described = json.loads(variable.removeprefix(mark))
                    yield _session({**described, "user": _user_of(int(name))})


def _user_of(pid: int) -> int | None:
    """The number of the user of a process, ``None`` if it has gone."""
    try:
        return os.stat(f"/proc/{pid}").st_uid
    except FileNotFoundError:
        return None


def _session(described: Mapping[str, Any]) -> Session:
    """The run that a reaper's environment describes, as it can be shown in a terminal.

    Raises:
        ControlError: if something lacks, or is of a wrong type.
    """
    return read_as(Session, _harmless(described))


def _harmless(value: Any) -> Any:
    """A value whose texts do nothing to a terminal."""
    if isinstance(value, str):
        return clean(value, keep_colours=False)
    if isinstance(value, dict):
        return {_harmless(key): _harmless(each) for key, each in value.items()}
    return [_harmless(each) for each in value] if isinstance(value, list) else value
