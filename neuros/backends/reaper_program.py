"""Program of the reaper process; :mod:`neuros.backends.reaper` explains it.

It is on duty as soon as it can find and kill the processes of the run: the launcher waits for
that, and for nothing else. So what takes longer to import, and only removes files, comes after.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib
import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import TYPE_CHECKING, Any

from neuros.backends.run_processes import RunProcesses

if TYPE_CHECKING:  # they take longer to import
    import subprocess
    from pathlib import Path

READY = b"ready\n"
IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
KILL_DEADLINE_S = 20.0
"""A process in an uninterruptible system call outlasts even SIGKILL."""

STARTED, FAILED, ENDED = "started", "failed", "ended"
"""What the launcher hears of a process: its number, an ``OSError``, its exit code."""

_PR_SET_CHILD_SUBREAPER = 36
_GRACE_S = 4.5  # nodes have this long when the launcher died; all is gone within 6 s
_POLL_S = 0.05
_SETTLE_S = 0.5
_REMOVE_S = 5.0


class Orders:
    """Orders of the launcher to the reaper so far."""

    def __init__(self) -> None:
        self._started_s, self._monotonic_s = time.time(), time.monotonic()
        self.grace_s = _GRACE_S
        self.sessions: list[int] = []
        self.paths: list[str] = []
        self.locks: list[tuple[int, str]] = []
        self.cleaners: list[tuple[str, str, str]] = []
        self.is_finished = False

    @property
    def started_s(self) -> float:
        """When this began, in Unix time; the clock may have been set back since then."""
        return min(self._started_s, time.time() - (time.monotonic() - self._monotonic_s))

    def take(self, order: str, value: object) -> None:
        if order == "session" and isinstance(value, int):
            self.sessions.append(value)
        elif order == "remove" and isinstance(value, str):
            self.paths.append(value)
        elif order == "lock" and isinstance(value, list):
            self.locks.append((int(value[0]), str(value[1])))
        elif order == "grace" and isinstance(value, (int, float)):
            self.grace_s, self.is_finished = float(value), True
        elif order == "clean" and isinstance(value, list):
            module, folder, argument = map(str, value)
            self.cleaners.append((module, folder, argument))


def main(run_id: str) -> None:
    """Obey the launcher until the pipe on standard input closes, then clean up."""
    for number in (*IGNORED, signal.SIGCHLD):
        signal.signal(number, lambda *_: None)  # as SIG_IGN, which processes would inherit
    signal.pthread_sigmask(signal.SIG_UNBLOCK, IGNORED)  # the launcher had them wait
    orders = Orders()
    processes = RunProcesses(run_id, os.getpid())
    children = _Children()
    os.write(1, READY)
    _import_the_rest()
    for order, value in _read_orders(children):
        orders.take(order, value)
        if order == "session" and isinstance(value, int):
            processes.add_session(value)
        elif order == "start" and isinstance(value, list):
            children.start(*value)
        elif order == "lock":
            os.set_inheritable(orders.locks[-1][0], False)
        elif order == "clean":
            _cleaners(orders)
    clean_up(run_id, orders, processes)


class _Children:
    """The processes that the launcher has had started here."""

    def __init__(self) -> None:
        self._launcher = os.getppid()
        self._running: dict[int, subprocess.Popen[bytes]] = {}

    def start(
        self,
        command: list[str],
        log: str,
        folder: str,
        environment: dict[str, str],
        cores: list[int],
    ) -> None:
        """Start one, and tell the launcher its number, or why not."""
        import subprocess
        from pathlib import Path

        from neuros.ordinary_files import open_log

        try:
            with open_log(Path(log)) as output, children_on(cores):
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    cwd=folder,
                    env=environment,
                    start_new_session=True,
                )
        except (OSError, ValueError) as error:  # a null byte in the environment, for instance
            parts = getattr(error, "errno", None), getattr(error, "filename", None)
            self._tell(FAILED, parts[0], getattr(error, "strerror", None) or str(error), parts[1])
        else:
            self._running[process.pid] = process
            self._tell(STARTED, process.pid)

    def reap(self) -> None:
        """Tell the launcher which have ended; orphans of the run have come here, too."""
        with contextlib.suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                if process := self._running.pop(ended[0], None):
                    process.returncode = os.waitstatus_to_exitcode(ended[1])
                    self._tell(ENDED, process.pid, process.returncode)
                    if os.getppid() == self._launcher:
                        os.kill(self._launcher, signal.SIGCHLD)  # as its own children do

    def _tell(self, *news: object) -> None:
        with contextlib.suppress(OSError):  # the launcher has gone
            os.write(1, json.dumps(news).encode() + b"\n")


@contextlib.contextmanager
def children_on(cores: Collection[int]) -> Iterator[None]:
    """Processes that this thread starts inside get these cores, and so do all their threads.

    The mask is there before the first instruction of the child: scripts, imports and the threads
    of DDS have it, too. Without any nothing changes. Raises ``OSError`` for one that is not there.
    """
    before = os.sched_getaffinity(0)
    if cores:
        os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        if cores:
            os.sched_setaffinity(0, before)


def _read_orders(children: _Children) -> Iterator[tuple[str, object]]:
    woken, waker = os.pipe()
    os.set_blocking(waker, False)
    signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    rest = b""
    while True:
        ready, _, _ = select.select([0, woken], [], [])
        if woken in ready:
            os.read(woken, 4096)
            children.reap()
        if 0 not in ready:
            continue
        received = os.read(0, 65536)
        if not received:
            return
        *lines, rest = (rest + received).split(b"\n")
        yield from map(json.loads, lines)


def _import_the_rest() -> None:
    """Now, and not when it is needed: who knows what becomes of the disk until then."""
    with contextlib.suppress(Exception):  # killing is the first duty, and needs none of it
        import ctypes
        import subprocess  # noqa: F401

        # What a process of the run has left behind comes to this one: a daemon, for instance.
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
        import neuros.backends.shared_memory
        import neuros.ordinary_files  # noqa: F401


def clean_up(run_id: str, orders: Orders, processes: RunProcesses | None = None) -> None:
    """End what is left of a run, after its grace period, and remove what it leaves."""
    if processes is None:
        processes = RunProcesses(run_id)
        for pid in orders.sessions:
            processes.add_session(pid)

    def resume() -> None:
        for cleaner, argument in _cleaners(orders):
            cleaner.resume(argument, run_id)

    _end_all(processes, orders.grace_s, resume)
    # What a killed launcher had asked for may still be on its way.
    settle_s = 0.0 if orders.is_finished else _SETTLE_S
    for cleaner, argument in _cleaners(orders):
        cleaner.remove(argument, run_id, settle_s=settle_s, give_up_s=_REMOVE_S)

    from pathlib import Path

    from neuros.backends.shared_memory import remove_dead_runs, sweep

    sweep(orders.started_s)
    _remove(orders.paths)
    for descriptor, path in orders.locks:
        remove_lock(descriptor, Path(path))
    remove_dead_runs()


def _end_all(processes: RunProcesses, grace_s: float, resume: Callable[[], None]) -> None:
    """Wait for all processes, and kill those that are left after the grace period.

    What is paused is resumed: at once, so that it can end by itself, and when it was killed.
    """
    now = time.monotonic()
    kill_at, give_up_at = now + grace_s, now + grace_s + KILL_DEADLINE_S
    pause_s = _POLL_S / 5
    resume_at = [now, kill_at]
    while (alive := processes.alive()) and time.monotonic() < give_up_at:
        if time.monotonic() >= kill_at:
            for pid in alive:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, signal.SIGKILL)
            pause_s = _POLL_S / 5
        if resume_at and time.monotonic() >= resume_at[0]:
            del resume_at[0]
            resume()
        time.sleep(max(0.001, min(pause_s, abs(kill_at - time.monotonic()))))
        pause_s = min(_POLL_S, pause_s * 2)


def _cleaners(orders: Orders) -> list[tuple[Any, str]]:
    """The modules that clean up, loaded when they are announced, each with its argument."""
    found = []
    for module, folder, argument in orders.cleaners:
        if folder not in sys.path:
            sys.path.append(folder)
        with contextlib.suppress(Exception):  # killing is the first duty, and needs none of it
            found.append((importlib.import_module(module), argument))
    return found


def _remove(paths: Iterable[str]) -> None:
    import shutil

    for path in paths:
        with contextlib.suppress(OSError):
            if os.path.isdir(path) and not os.path.islink(path):
                shutil.rmtree(path, ignore_errors=True)
            else:
                os.unlink(path)


def remove_lock(descriptor: int, path: Path) -> None:
    """Remove the lock file of a domain unless another run holds it, too, or has made a new one."""
    with contextlib.suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if is_same_file(descriptor, path):
            path.unlink()


def is_same_file(descriptor: int, path: Path) -> bool:
    """Whether an open file is the one of this path."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False
