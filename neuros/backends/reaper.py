"""The reaper: a process that outlives the launcher and ends the processes of its run.

It holds the read end of a pipe whose write end only the launcher has. When the pipe closes, the
launcher has ended, also by SIGKILL. Then the reaper lets the nodes end by themselves for a grace
period, kills the processes of the run until none is left, and removes the files of killed
nodes: shared memory, sockets, temporary folders.

The node processes are children of the reaper, and it is their subreaper
(``PR_SET_CHILD_SUBREAPER``): orphans become its children. So all their descendants belong to the
run, daemons too. The launcher cannot be the subreaper: it may be a user's program with other
children.

Other processes belong to the run by their environment (``NEUROS_RUN_ID``), or by the session of a
process that the launcher announced. A launcher whose reaper was killed finds the nodes in the same
way.

The reaper starts first, without site-packages, ignores the signals that a terminal or a service
manager sends, and needs only the standard library. This module is the launcher's end;
:mod:`neuros.backends.reaper_program` is the program of the process.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from neuros.backends.domain import DomainLock
from neuros.backends.reaper_program import (
    ENDED,
    FAILED,
    IGNORED,
    KILL_DEADLINE_S,
    READY,
    Orders,
    clean_up,
)
from neuros.backends.run_processes import RUN_ID, started_at
from neuros.errors import EnvironmentFault

_PROGRAM = (
    "import sys; sys.path.insert(0, sys.argv[1]); "
    "from neuros.backends.reaper_program import main; main(sys.argv[2])"
)
_START_DEADLINE_S = 10.0
_POLL_S = 0.02
UNKNOWN = -1000
"""The exit code of a process whose reaper was killed before it ended."""


class Reaper:
    """The launcher's handle on its reaper.

    Example::

        reaper = Reaper.start(run_id, domain_lock)
        reaper.remove_later(socket_path)
        process = reaper.spawn(command, log, folder, environment)
        reaper.finish()
    """

    def __init__(self, run_id: str, process: subprocess.Popen[bytes], pipe: int) -> None:
        self._run_id = run_id
        self._process = process
        self._pipe: int | None = pipe
        self._has_finished = False
        self._orders = Orders()
        self._received = b""
        self._lock = threading.Lock()
        self._codes: dict[int, int] = {}
        self._has_hung_up = False

    @classmethod
    def start(
        cls,
        run_id: str,
        lock: DomainLock | None = None,
        environment: Mapping[str, str] = MappingProxyType({}),
    ) -> Reaper:
        """Start a reaper and wait until it is on duty.

        Args:
            lock: the reaper holds it, too, so that no other run gets the domain before the last
                node is gone, and removes the lock file in the end.
            environment: is added to that of the reaper.

        Raises:
            EnvironmentFault: if it cannot be started.
        """
        descriptor = lock.fileno() if lock else None
        inherited = {key: value for key, value in os.environ.items() if key != RUN_ID}
        root = str(Path(__file__).resolve().parents[2])
        read_end, write_end = os.pipe()
        # Ctrl+C would kill the reaper between its fork and its own session, or before it ignores
        # signals: the process starts with them blocked.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, IGNORED)
        try:
            process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _PROGRAM, root, run_id],
                stdin=read_end,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                cwd="/",
                env={**inherited, **environment},
                start_new_session=True,
                pass_fds=() if descriptor is None else (descriptor,),
            )
        except OSError as error:
            os.close(write_end)
            raise EnvironmentFault(f"the reaper process cannot be started: {error}") from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            os.close(read_end)
        reaper = cls(run_id, process, write_end)
        try:
            if reaper._receive(_START_DEADLINE_S) != [READY]:
                raise EnvironmentFault(
                    f"the reaper process did not start ({sys.executable}): nothing was started,"
                    " since without it a killed launcher would leave nodes behind"
                )
        except BaseException:
            process.kill()
            process.communicate()
            os.close(write_end)
            raise
        if lock and lock.path and descriptor is not None:
            reaper._send("lock", [descriptor, str(lock.path)])
        return reaper

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def is_on_duty(self) -> bool:
        """Whether it runs; it may have been killed."""
        return self._process.poll() is None

    def spawn(
        self,
        command: Sequence[str],
        log: Path,
        folder: Path,
        environment: Mapping[str, str],
        cores: Sequence[int] = (),
    ) -> ReaperChild:
        """Start a process in a session of its own, without input; its output goes to the log.

        Raises ``OSError``.
        """
        paths = os.fspath(log.absolute()), os.fspath(folder.absolute())
        with self._lock:
            self._send("start", [[*command], *paths, dict(environment), [*cores]])
            while (answer := self._receive(None)) and answer[0] == ENDED:
                pass
        if answer is None:
            raise OSError("the reaper was killed")
        if answer[0] == FAILED:
            raise OSError(*answer[1:])
        self._orders.add("session", answer[1])
        return ReaperChild(self, answer[1])

    def code_of(self, process: ReaperChild) -> int | None:
        """The exit code of a process that the reaper has started; ``None`` while it runs."""
        with self._lock:
            while process.pid not in self._codes and self._receive(0.0):
                pass
            if self._has_hung_up and not process.is_there:
                self._codes.setdefault(process.pid, UNKNOWN)
            return self._codes.get(process.pid)

    def watch(self, pid: int) -> None:
        """Announce a process that leads a session of its own."""
        self._send("session", pid)

    def remove_later(self, path: Path) -> None:
        """Have a file, socket or folder removed once all processes of the run are gone."""
        self._send("remove", os.fspath(path.absolute()))

    def clean_with(self, module: str, argument: str) -> None:
        """As :class:`neuros.ports.Reaper` says."""
        file = Path(str(sys.modules[module].__file__))
        depth = module.count(".") + (file.name == "__init__.py")
        self._send("clean", [module, str(file.parents[depth]), argument])

    def leave(self, grace_s: float = 0.0) -> None:
        """Let the reaper clean up; processes get ``grace_s`` seconds to end by themselves.

        A second call has no effect.
        """
        if self._pipe is not None:
            self._send("grace", grace_s)
            os.close(self._pipe)
            self._pipe = None

    def finish(self, grace_s: float = 0.0) -> None:
        """Let the reaper clean up, and wait for its end.

        A second call has no effect.
        """
        self.leave(grace_s)
        if self._has_finished:
            return
        self._has_finished = True
        try:
            self._process.wait(self._orders.grace_s + KILL_DEADLINE_S + 5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        with self._lock:
            while self._receive(None):
                pass
        assert self._process.stdout is not None
        self._process.stdout.close()
        if self._process.returncode != 0:  # it was killed: this process cleans up
            clean_up(self._run_id, self._orders)

    def _send(self, order: str, value: object) -> None:
        self._orders.add(order, value)
        if self._pipe is None:
            return
        rest = memoryview(json.dumps([order, value]).encode() + b"\n")
        with contextlib.suppress(BrokenPipeError):  # finish() notices that the reaper is gone
            while rest:
                rest = rest[os.write(self._pipe, rest) :]

    def _receive(self, timeout_s: float | None) -> list[Any] | None:
        """The next answer, ``None`` if there is none; records exit codes."""
        while b"\n" not in self._received:
            assert self._process.stdout is not None
            if self._has_hung_up or not select.select([self._process.stdout], [], [], timeout_s)[0]:
                return None
            received = os.read(self._process.stdout.fileno(), 65536)
            if not received:
                self._has_hung_up = True
                return None
            self._received += received
        line, _, self._received = self._received.partition(b"\n")
        answer: list[Any] = json.loads(line)
        if answer[0] == ENDED:
            self._codes[answer[1]] = answer[2]
        return answer


class ReaperChild:
    """A process that the reaper has started.

    Attributes:
        pid: its process id, which is also that of its process group and session.
    """

    def __init__(self, reaper: Reaper, pid: int) -> None:
        self.pid = pid
        self._reaper = reaper
        self._started = started_at(pid)

    @property
    def is_there(self) -> bool:
        """Whether the kernel has it."""
        return self._started is not None and started_at(self.pid) == self._started

    def poll(self) -> int | None:
        """``None`` while it runs, then its exit code, negative for a signal."""
        return self._reaper.code_of(self)

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
