"""The guardian: a process that starts the processes of a run, outlives the launcher, and ends them.

It holds one end of a socket whose other end only the launcher has. When that closes, the launcher
has ended, also by SIGKILL. Then the guardian lets the nodes end by themselves for a grace period,
kills what is left, and removes the files of killed nodes: shared memory, sockets, lock files.

The node processes are children of the guardian, and it is their subreaper
(``PR_SET_CHILD_SUBREAPER``, prctl(2)): orphans become its children, daemons too. So what descends
from a node belongs to the run until the guardian has no child left. The launcher cannot be the
subreaper: it may be a user's program with other children. Processes that the launcher has started
itself have the run's id in their environment, or are announced.

The guardian is also the fork server of nodes: it imports NeuROS and ROS once, while the launcher
plans the run, and forks a node process with all of that in place. What a library reads from the
environment when it is loaded must be as in the guardian; otherwise, and for other programs, a
process is started by ``execve``. A fork differs from such a process in nothing that a plugin or a
tool sees: command line and environment in ``/proc``, output, session, signals, cores, random seeds.

If the guardian itself was killed, the launcher ends the processes that have the run's id in their
environment, and removes the files. This module is the launcher's end;
:mod:`neuros.backends.guardian_program` is the program of the process.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.backends.domain import FileLock
from neuros.backends.guardian_program import (
    ENDED,
    FAILED,
    IGNORED,
    KILL_DEADLINE_S,
    READY,
    Orders,
    clean_up,
)
from neuros.backends.node_command import process_environment, with_libraries
from neuros.backends.run_processes import RUN_ID, RunProcesses, started_at
from neuros.distribution import python_command
from neuros.errors import EnvironmentFault
from neuros.ports import BackEnd

_PROGRAM = "from neuros.backends.guardian_program import main; main(sys.argv[1])"
_START_DEADLINE_S = 10.0
_POLL_S = 0.02
UNKNOWN = -1000
"""The exit code of a process whose guardian was killed before it ended."""


class Guardian:
    """The launcher's handle on its guardian.

    Example::

        guardian = Guardian.start(run_id)
        guardian.hold(domain_lock)
        guardian.remove_later(socket_path)
        process = guardian.spawn(command, log, folder, environment)
        guardian.finish()

    Attributes:
        run_id: the id of the run.
    """

    def __init__(self, run_id: str, process: subprocess.Popen[bytes], link: socket.socket) -> None:
        self.run_id = run_id
        self._process = process
        self._link = link
        self._has_left = self._has_finished = self._has_hung_up = False
        self._is_ready = False
        self._orders = Orders()
        self._received = b""
        self._lock = threading.Lock()
        self._codes: dict[int, int] = {}

    @classmethod
    def start(cls, run_id: str) -> Guardian:
        """Start a guardian; :meth:`await_ready` waits until it is on duty.

        Raises:
            EnvironmentFault: if it cannot be started.
        """
        inherited = {key: value for key, value in os.environ.items() if key != RUN_ID}
        ours, theirs = socket.socketpair()
        # Ctrl+C would kill the guardian between its fork and its own session, or before it ignores
        # signals: the process starts with them blocked.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, IGNORED)
        try:
            process = subprocess.Popen(
                python_command(run_id, python=sys.executable, code=_PROGRAM),
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd="/",
                env=with_libraries(process_environment(inherited, {})),
                start_new_session=True,
            )
        except OSError as error:
            ours.close()
            raise EnvironmentFault(f"the guardian process cannot be started: {error}") from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            theirs.close()
        return cls(run_id, process, ours)

    def await_ready(self) -> None:
        """Wait until it can end what it starts.

        Raises:
            EnvironmentFault: if that fails.
        """
        if not self._is_ready:
            self._is_ready = self._receive(_START_DEADLINE_S) == [READY]
        if not self._is_ready:
            self._abandon()
            raise EnvironmentFault(
                f"the guardian process did not start ({sys.executable}): nothing was started,"
                " since without it a killed launcher would leave nodes behind"
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def is_on_duty(self) -> bool:
        """Whether it runs; it may have been killed."""
        return self._process.poll() is None

    def import_early(self, *calls: Sequence[str], folders: Sequence[Path] = ()) -> None:
        """Have modules imported that forks need.

        Args:
            calls: of each the module, and perhaps a function in it to call, with its arguments.
            folders: where Python looks for modules before all others.
        """
        self._send("import", [[*map(str, folders)], calls])

    def spawn(
        self,
        command: Sequence[str],
        log: Path,
        folder: Path,
        environment: Mapping[str, str],
        cores: Sequence[int] = (),
    ) -> GuardedProcess:
        """Start a process in a session of its own, without input; its output goes to the log.

        Raises ``OSError``.
        """
        paths = os.fspath(log.absolute()), os.fspath(folder.absolute())
        self.await_ready()
        with self._lock:
            self._send("start", [[*command], *paths, dict(environment), [*cores]])
            while (answer := self._receive(None)) and answer[0] == ENDED:
                pass
        if answer is None:
            raise OSError("the guardian was killed")
        if answer[0] == FAILED:
            raise OSError(*answer[1:])
        return GuardedProcess(self, answer[1])

    def code_of(self, process: GuardedProcess) -> int | None:
        """The exit code of a process that the guardian has started; ``None`` while it runs."""
        with self._lock:
            while process.pid not in self._codes and self._receive(0.0):
                pass
            if self._has_hung_up and not process.is_there:
                self._codes.setdefault(process.pid, UNKNOWN)
            return self._codes.get(process.pid)

    def watch(self, pid: int) -> None:
        """As :class:`neuros.ports.Guardian` says."""
        self._send("watch", pid)

    def hold(self, lock: FileLock) -> None:
        """Have a file stay locked until the last process of the run is gone, and then removed."""
        if lock.path is not None and (descriptor := lock.fileno()) is not None:
            self._send("lock", str(lock.path), descriptor)

    def remove_later(self, path: Path) -> None:
        """Have a file, socket or folder removed once all processes of the run are gone."""
        self._send("remove", os.fspath(path.absolute()))

    def clean_with(self, module: str, argument: str) -> None:
        """As :class:`neuros.ports.Guardian` says."""
        file = Path(str(sys.modules[module].__file__))
        depth = module.count(".") + (file.name == "__init__.py")
        self._send("clean", [module, str(file.parents[depth]), argument])

    def leave(self, grace_s: float = 0.0) -> None:
        """Let the guardian clean up; processes get ``grace_s`` seconds to end by themselves.

        A second call has no effect.
        """
        if not self._has_left:
            self._send("grace", grace_s)
            self._has_left = True
            self._link.shutdown(socket.SHUT_WR)

    def finish(self, grace_s: float = 0.0) -> None:
        """Let the guardian clean up, and wait for its end.

        A second call has no effect.
        """
        self.leave(grace_s)
        if self._has_finished:
            return
        self._has_finished = True
        if not self._is_ready:  # nothing was to be started
            self._abandon()
            return
        try:
            self._process.wait(self._orders.grace_s + KILL_DEADLINE_S + 5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        with self._lock:
            while self._receive(None):
                pass
        self._link.close()
        if self._process.returncode != 0:  # it was killed: this process cleans up
            clean_up(self.run_id, self._orders, RunProcesses(self.run_id).alive)

    def _abandon(self) -> None:
        self._process.kill()
        self._process.wait()
        self._link.close()

    def _send(self, order: str, value: object, *descriptors: int) -> None:
        self._orders.add(order, [*descriptors, value] if descriptors else value)
        if self._has_left:
            return
        rest = json.dumps([order, value]).encode() + b"\n"
        with contextlib.suppress(OSError):  # finish() notices that the guardian is gone
            if descriptors:
                rest = rest[socket.send_fds(self._link, [rest], descriptors) :]
            self._link.sendall(rest)

    def _receive(self, timeout_s: float | None) -> list[Any] | None:
        """The next answer, ``None`` if there is none; records exit codes."""
        while b"\n" not in self._received:
            if self._has_hung_up or not select.select([self._link], [], [], timeout_s)[0]:
                return None
            received = b""
            with contextlib.suppress(ConnectionError):
                received = self._link.recv(65536)
            if not received:
                self._has_hung_up = True
                return None
            self._received += received
        line, _, self._received = self._received.partition(b"\n")
        answer: list[Any] = json.loads(line)
        if answer[0] == ENDED:
            self._codes[answer[1]] = answer[2]
        return answer


def start_guardian(back_end: BackEnd) -> Guardian:
    """Start the guardian of a run, which begins to import what forks need.

    Raises:
        EnvironmentFault: if it cannot be started.
    """
    guardian = Guardian.start(os.urandom(8).hex())
    if back_end.is_forked:
        program = "neuros.cli.node"
        guardian.import_early(["neuros.cli.main"], [program, "load_transport", back_end.transport])
    return guardian


class GuardedProcess:
    """A process that the guardian has started.

    Attributes:
        pid: its process id, which is also that of its process group and session.
    """

    def __init__(self, guardian: Guardian, pid: int) -> None:
        self.pid = pid
        self._guardian = guardian
        self._started = started_at(pid)

    @property
    def is_there(self) -> bool:
        return self._started is not None and started_at(self.pid) == self._started

    def poll(self) -> int | None:
        """``None`` while it runs, then its exit code, negative for a signal."""
        return self._guardian.code_of(self)

    def wait(self, timeout_s: float) -> None:
        """Wait until it has ended, at most ``timeout_s`` seconds."""
        give_up_s = time.monotonic() + timeout_s
        while self.poll() is None and (left_s := give_up_s - time.monotonic()) > 0:
            time.sleep(min(left_s, _POLL_S))

    def send_signal(self, number: int, *, is_for_group: bool = False) -> None:
        """Send a signal to it, or to its process group, unless it has ended."""
        # The number of a reaped process may be another's.
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                (os.killpg if is_for_group else os.kill)(self.pid, number)
