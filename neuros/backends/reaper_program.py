"""Program of the reaper process; :mod:`neuros.backends.reaper` explains it.

It answers READY as soon as it can find and kill the processes of the run; the launcher waits only
for that. Modules that take longer to import, and only remove files, are imported after that.
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
from collections.abc import Callable, Collection, Iterator
from typing import TYPE_CHECKING, Any

from neuros.backends.run_processes import RunProcesses

if TYPE_CHECKING:  # they take longer to import
    import subprocess
    from pathlib import Path

IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
KILL_DEADLINE_S = 20.0
"""A process in an uninterruptible system call outlasts even SIGKILL."""

READY, STARTED, FAILED, ENDED = "ready", "started", "failed", "ended"
"""Answers to the launcher: on duty; of a process its number, an ``OSError``, its exit code."""

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
        self.is_finished = False
        self.sessions: list[int] = []
        self.paths: list[str] = []
        self.locks: list[tuple[int, str]] = []
        self.cleaners: list[tuple[str, str, str]] = []
        self._lists: dict[str, list[Any]] = {
            "session": self.sessions,
            "remove": self.paths,
            "lock": self.locks,
            "clean": self.cleaners,
        }

    @property
    def started_s(self) -> float:
        """When this began, in Unix time; the clock may have been set back since then."""
        return min(self._started_s, time.time() - (time.monotonic() - self._monotonic_s))

    def add(self, order: str, value: Any) -> None:
        """Remember an order, except that to start a process."""
        if order == "grace":
            self.grace_s, self.is_finished = value, True
        elif order in self._lists:
            self._lists[order].append(value)


def main(run_id: str) -> None:
    """Follow the launcher's orders until the pipe on standard input closes, then clean up."""
    for number in (*IGNORED, signal.SIGCHLD):
        signal.signal(number, lambda *_: None)  # processes would inherit SIG_IGN
    signal.pthread_sigmask(signal.SIG_UNBLOCK, IGNORED)  # the launcher has blocked them
    orders = Orders()
    processes = RunProcesses(run_id, os.getpid())
    children = _Children()
    _answer(READY)
    _import_the_rest()
    for order, value in _read_orders(children):
        orders.add(order, value)
        if order == "session":
            processes.add_session(value)
        elif order == "start":
            children.start(*value)
        elif order == "lock":
            os.set_inheritable(value[0], False)
        elif order == "clean":
            _cleaners(orders)
    clean_up(run_id, orders, processes)


def _answer(*answer: object) -> None:
    with contextlib.suppress(OSError):  # the launcher has gone
        os.write(1, json.dumps(answer).encode() + b"\n")


class _Children:
    """Processes that the reaper has started for the launcher."""

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
        """Start a process; the answer is its number, or the error."""
        import subprocess

        try:
            with open(log, "ab") as output, children_on(cores):
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
            _answer(FAILED, parts[0], getattr(error, "strerror", None) or str(error), parts[1])
        else:
            self._running[process.pid] = process
            _answer(STARTED, process.pid)

    def reap(self) -> None:
        """Answer which processes have ended; orphans of the run are children of the reaper, too."""
        with contextlib.suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                if process := self._running.pop(ended[0], None):
                    process.returncode = os.waitstatus_to_exitcode(ended[1])
                    _answer(ENDED, process.pid, process.returncode)
                    if os.getppid() == self._launcher:
                        os.kill(self._launcher, signal.SIGCHLD)  # as children of its own do


@contextlib.contextmanager
def children_on(cores: Collection[int]) -> Iterator[None]:
    """Processes that this thread starts in this context get these cores, and all their threads.

    The mask counts from the first instruction of the child: for scripts, imports and the threads
    of DDS, too. An empty ``cores`` changes nothing. Raises ``OSError`` for a core that is absent.
    """
    before = os.sched_getaffinity(0)
    if cores:
        os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        if cores:
            os.sched_setaffinity(0, before)


def _read_orders(children: _Children) -> Iterator[tuple[str, Any]]:
    """Orders until the launcher ends; meanwhile children that end are reaped."""
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
    """Import early: the disk may be gone when the run ends."""
    with contextlib.suppress(Exception):  # killing is the first duty, and needs no import
        import ctypes
        import subprocess  # noqa: F401

        # Orphans of the run, such as daemons, become children of this process.
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
        import neuros.backends.shared_memory  # noqa: F401


def clean_up(run_id: str, orders: Orders, processes: RunProcesses | None = None) -> None:
    """End the processes of a run after its grace period, and remove its files."""
    if processes is None:
        processes = RunProcesses(run_id)
        for pid in orders.sessions:
            processes.add_session(pid)

    def resume() -> None:
        for cleaner, argument in _cleaners(orders):
            cleaner.resume(argument, run_id)

    _end_all(processes, orders.grace_s, resume)
    # Orders of a killed launcher, to an engine for instance, may still be under way.
    settle_s = 0.0 if orders.is_finished else _SETTLE_S
    for cleaner, argument in _cleaners(orders):
        cleaner.remove(argument, run_id, settle_s=settle_s, give_up_s=_REMOVE_S)

    import shutil
    from pathlib import Path

    from neuros.backends.shared_memory import remove_dead_runs, sweep

    sweep(orders.started_s)
    for path in orders.paths:
        with contextlib.suppress(OSError):
            if os.path.isdir(path) and not os.path.islink(path):
                shutil.rmtree(path, ignore_errors=True)
            else:
                os.unlink(path)
    for descriptor, lock in orders.locks:
        remove_lock(descriptor, Path(lock))
    remove_dead_runs()


def _end_all(processes: RunProcesses, grace_s: float, resume: Callable[[], None]) -> None:
    """Wait for all processes, and kill those that are left after the grace period.

    Paused nodes are resumed at once, so that they can end, and again when they are killed.
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
    """The modules that clean up, imported as soon as they are announced, and their arguments."""
    found = []
    for module, folder, argument in orders.cleaners:
        if folder not in sys.path:
            sys.path.append(folder)
        with contextlib.suppress(Exception):  # killing is the first duty, and needs no import
            found.append((importlib.import_module(module), argument))
    return found


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
