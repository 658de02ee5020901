"""The reaper: a process that outlives the launcher and ends what is left of its run.

It holds the read end of a pipe whose write end only the launcher has. When the pipe closes, the
launcher has ended, also by SIGKILL. Then the reaper lets the nodes end by themselves for a grace
period, kills what is left of the run, again and again until nothing is, and removes what killed
nodes leave: shared memory, sockets, temporary folders.

A process belongs to the run if the environment it was started with names the run
(``NEUROS_RUN_ID``): children inherit that through double forks and new sessions. Further, if it is
in the session of a process that the launcher announced, or a child of a process of the run: that
finds those that were started with an empty environment.

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
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

from neuros.backends.domain import DomainLock
from neuros.backends.reaper_program import IGNORED, KILL_DEADLINE_S, READY, Orders, clean_up
from neuros.backends.run_processes import RUN_ID
from neuros.errors import EnvironmentFault

_PROGRAM = (
    "import sys; sys.path.insert(0, sys.argv[1]); "
    "from neuros.backends.reaper_program import main; main(sys.argv[2])"
)
_START_DEADLINE_S = 10.0


class Reaper:
    """The launcher's handle on its reaper.

    Example::

        reaper = Reaper.start(run_id, domain_lock)
        reaper.remove_later(socket_path)
        ...  # start nodes with NEUROS_RUN_ID=run_id, announce each: reaper.watch(pid)
        reaper.finish()
    """

    def __init__(self, run_id: str, process: subprocess.Popen[bytes], pipe: int) -> None:
        self._run_id = run_id
        self._process = process
        self._pipe: int | None = pipe
        self._has_finished = False
        self._orders = Orders()

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
        if self._process.returncode != 0:  # it was killed: its duty falls to us
            clean_up(self._run_id, self._orders)

    def _tell(self, order: str, value: object) -> None:
        self._orders.take(order, value)
        if self._pipe is None:
            return
        with contextlib.suppress(BrokenPipeError):  # finish() sees that it is gone
            os.write(self._pipe, json.dumps([order, value]).encode() + b"\n")

    def _await_ready(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as answer:
            ready, _, _ = select.select([answer], [], [], _START_DEADLINE_S)
            if ready and answer.read(len(READY)) == READY:
                return
        raise EnvironmentFault(
            f"the reaper process did not start ({sys.executable}): nothing was started, since "
            "without it a killed launcher would leave nodes behind"
        )

    def _kill(self) -> None:
        self._process.kill()
        self._process.wait()
        if self._pipe is not None:
            os.close(self._pipe)
            self._pipe = None


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
