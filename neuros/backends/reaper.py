"""The reaper: a process that outlives the launcher and ends what is left of its run.

It holds the read end of a pipe whose write end only the launcher has. When the pipe closes, the
launcher has ended, also by SIGKILL. Then the reaper lets the nodes end by themselves for a grace
period, kills what is left of the run, again and again until nothing is, and removes what killed
nodes leave: shared memory, sockets, temporary folders.

The node processes are its children, and it is their subreaper (``PR_SET_CHILD_SUBREAPER``): what
loses its parent becomes its child. So all that descends from them belongs to the run, daemons too.
The launcher cannot be that: it may be a program of the user, with other children.

What else belongs to the run, the environment tells that it was started with (``NEUROS_RUN_ID``), or
the session of a process that the launcher announced. A launcher whose reaper was killed finds the
nodes in the same way.

The reaper is started first, without site-packages, ignores the signals that a terminal or a
service manager sends, and needs nothing but the standard library. This is the launcher's end;
:mod:`neuros.backends.reaper_program` is the program of the process itself.
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
from collections.abc import Iterator, Mapping, Sequence
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
_LOOK_S = 0.02
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
        self._news = b""
        self._lock = threading.Lock()
        self._codes: dict[int, int] = {}
        self._is_silent = False

    @classmethod
    def start(
        cls,
        run_id: str,
        lock: DomainLock | None = None,
        environment: Mapping[str, str] = MappingProxyType({}),
    ) -> Reaper:
        """Start a reaper and wait until it is on duty.

        It holds ``lock``, too, so that no run takes the domain before the last node is gone, and
        removes the lock file in the end. ``environment`` is added to its own. Raises
        ``EnvironmentFault``.
        """
        descriptor = lock.fileno() if lock else None
        inherited = {key: value for key, value in os.environ.items() if key != RUN_ID}
        root = str(Path(__file__).resolve().parents[2])
        read_end, write_end = os.pipe()
        try:
            with _signals_held_up():
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
            os.close(read_end)
        reaper = cls(run_id, process, write_end)
        try:
            reaper._await_ready()
        except BaseException:
            reaper._kill()
            raise
        if lock and lock.path and descriptor is not None:
            reaper._tell("lock", [descriptor, str(lock.path)])
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
            self._tell("start", [[*command], *paths, dict(environment), [*cores]])
            while (news := self._hear(None)) and news[0] == ENDED:
                pass
        if news is None:
            raise OSError("the reaper was killed")
        if news[0] == FAILED:
            raise OSError(*news[1:3], *news[3:])
        self._orders.take("session", news[1])
        return ReaperChild(self, news[1])

    def code_of(self, process: ReaperChild) -> int | None:
        """The exit code of a process that it has started, ``None`` while that runs."""
        with self._lock:
            while process.pid not in self._codes and self._hear(0.0):
                pass
            if self._is_silent and not process.is_there:
                self._codes.setdefault(process.pid, UNKNOWN)
            return self._codes.get(process.pid)

    def watch(self, pid: int) -> None:
        """Announce a process that leads a session of its own."""
        self._tell("session", pid)

    def remove_later(self, path: Path) -> None:
        """Have a file, socket or folder removed once all processes of the run are gone."""
        self._tell("remove", os.fspath(path.absolute()))

    def clean_with(self, module: str, argument: str) -> None:
        """As :class:`neuros.ports.Reaper` says."""
        file = Path(str(sys.modules[module].__file__))
        depth = module.count(".") + (file.name == "__init__.py")
        self._tell("clean", [module, str(file.parents[depth]), argument])

    def leave(self, grace_s: float = 0.0) -> None:
        """Leave the rest to the reaper; what still runs gets ``grace_s`` seconds to end by itself.

        A second call has no effect.
        """
        if self._pipe is not None:
            self._tell("grace", grace_s)
            os.close(self._pipe)
            self._pipe = None

    def finish(self, grace_s: float = 0.0) -> None:
        """Leave the rest to the reaper, if that was not done, and wait for it.

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
            while self._hear(None):
                pass
        assert self._process.stdout is not None
        self._process.stdout.close()
        if self._process.returncode != 0:  # it was killed: its duty falls to us
            clean_up(self._run_id, self._orders)

    def _tell(self, order: str, value: object) -> None:
        self._orders.take(order, value)
        if self._pipe is None:
            return
        rest = memoryview(json.dumps([order, value]).encode() + b"\n")
        with contextlib.suppress(BrokenPipeError):  # finish() sees that it is gone
            while rest:
                rest = rest[os.write(self._pipe, rest) :]

    def _hear(self, timeout_s: float | None) -> list[Any] | None:
        """The next news, ``None`` if there is none; ends are noted."""
        while b"\n" not in self._news:
            assert self._process.stdout is not None
            if self._is_silent or not select.select([self._process.stdout], [], [], timeout_s)[0]:
                return None
            received = os.read(self._process.stdout.fileno(), 65536)
            if not received:
                self._is_silent = True
                return None
            self._news += received
        line, _, self._news = self._news.partition(b"\n")
        news: list[Any] = json.loads(line)
        if news[0] == ENDED:
            self._codes[news[1]] = news[2]
        return news

    def _await_ready(self) -> None:
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], _START_DEADLINE_S)
        if ready and os.read(self._process.stdout.fileno(), len(READY)) == READY:
            return
        raise EnvironmentFault(
            f"the reaper process did not start ({sys.executable}): nothing was started, since "
            "without it a killed launcher would leave nodes behind"
        )

    def _kill(self) -> None:
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()
        if self._pipe is not None:
            os.close(self._pipe)
            self._pipe = None


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
        """Whether it runs, as the kernel sees it."""
        return self._started is not None and started_at(self.pid) == self._started

    def poll(self) -> int | None:
        """``None`` while it runs, then its exit code, negative for a signal."""
        return self._reaper.code_of(self)

    def wait(self, timeout_s: float) -> None:
        """Until it has ended, or ``timeout_s`` seconds have passed."""
        give_up_s = time.monotonic() + timeout_s
        while self.poll() is None and (left_s := give_up_s - time.monotonic()) > 0:
            time.sleep(min(left_s, _LOOK_S))

    def send_signal(self, number: int, *, is_for_group: bool = False) -> None:
        """Send a signal to it, or to its process group; does nothing where it has ended."""
        # Once it has been reaped, its number may be another's.
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                (os.killpg if is_for_group else os.kill)(self.pid, number)


@contextlib.contextmanager
def _signals_held_up() -> Iterator[None]:
    """Block the signals that a reaper ignores, until this is over; its process starts with them so.

    Ctrl+C would kill it otherwise between its fork and its own session, or before it ignores it.
    """
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, IGNORED)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
