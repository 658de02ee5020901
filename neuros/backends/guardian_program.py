"""Program of the guardian process; :mod:`neuros.backends.guardian` explains it."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import gc
import importlib
import json
import os
import re
import runpy
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.backends.run_processes import RunProcesses, children, show_as, started_at
from neuros.backends.shared_memory import remove_dead_runs, sweep
from neuros.distribution import python_command

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

# What Python, the C library and the libraries of numbers and of ROS read when they are loaded.
_READ_EARLY = re.compile(
    r"(PYTHON|LD_|MALLOC_|GLIBC_|LC_|OMP_|KMP_|GOMP_|OPENBLAS_|GOTO_|MKL_|BLIS_|NPY_|NUMPY_|RMW_)"
    r".*|LANG|LANGUAGE|TZ|TZDIR|HOME|AMENT_PREFIX_PATH"
)
_PYTHON_PATH = "PYTHONPATH"


class Orders:
    """Orders of the launcher to the guardian so far, but for those to start a process."""

    def __init__(self) -> None:
        self._started_s, self._monotonic_s = time.time(), time.monotonic()
        self.grace_s = _GRACE_S
        self.is_finished = False
        self.watched: dict[int, int | None] = {}
        self.paths: list[str] = []
        self.locks: list[tuple[int, str]] = []
        self.cleaners: list[tuple[str, str, str]] = []

    @property
    def started_s(self) -> float:
        """When this began, in Unix time; the clock may have been set back since then."""
        return min(self._started_s, time.time() - (time.monotonic() - self._monotonic_s))

    def add(self, order: str, value: Any) -> None:
        match order:
            case "grace":
                self.grace_s, self.is_finished = value, True
            case "watch":
                self.watched[value] = started_at(value)
            case "remove":
                self.paths.append(value)
            case "lock":
                self.locks.append(value)
            case "clean":
                self.cleaners.append(value)


def main(run_id: str) -> None:
    """Follow the launcher's orders until it has gone, then clean up; in a fork: run the module."""
    for number in (*IGNORED, signal.SIGCHLD):
        signal.signal(number, lambda *_: None)  # processes would inherit SIG_IGN
    signal.pthread_sigmask(signal.SIG_UNBLOCK, IGNORED)  # the launcher has blocked them
    # Orphans of the run, such as daemons, become children of this process.
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
    guardian = _Guardian(socket.socket(fileno=os.dup(0)))
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)  # processes inherit it
    guardian.serve()
    if guardian.arguments:
        sys.argv[1:] = guardian.arguments
        runpy.run_module(sys.argv.pop(1), None, "__main__", alter_sys=True)
        return
    marked = RunProcesses(run_id)
    clean_up(run_id, guardian.orders, lambda: {*children(), *marked.alive()})


class _Guardian:
    """Starts processes for the launcher, and reaps them.

    Attributes:
        arguments: in a fork, the module that it runs, and its arguments.
    """

    def __init__(self, link: socket.socket) -> None:
        self.orders = Orders()
        self.arguments: Sequence[str] = ()
        self._link = link
        self._launcher = os.getppid()
        self._running: dict[int, subprocess.Popen[bytes] | None] = {}
        self._woken, self._waker = os.pipe()
        os.set_blocking(self._waker, False)
        self._can_show = show_as([*sys.orig_argv], os.environ)

    def serve(self) -> None:
        """Follow orders until the launcher has gone; children that end meanwhile are reaped."""
        signal.set_wakeup_fd(self._waker, warn_on_full_buffer=False)
        gc.disable()
        self._answer(READY)
        rest, descriptors = b"", list[int]()
        while True:
            ready, _, _ = select.select([self._link.fileno(), self._woken], [], [])
            if self._woken in ready:
                os.read(self._woken, 4096)
                self._reap()
            if self._link.fileno() not in ready:
                continue
            try:
                received, given, _, _ = socket.recv_fds(self._link, 65536, 8)
            except ConnectionError:  # it was killed before it had read all answers
                return
            if not received:
                return
            descriptors += given
            *lines, rest = (rest + received).split(b"\n")
            for line in lines:
                order, value = json.loads(line)
                if order == "start":
                    self._start(*value)
                    if self.arguments:
                        return
                elif order == "import":
                    self._import(*value)
                elif order == "lock":
                    self.orders.add(order, [descriptors.pop(0), value])
                else:
                    self.orders.add(order, value)
                    _cleaners(self.orders)  # the disk may be gone when the run ends

    def _answer(self, *answer: object) -> None:
        with contextlib.suppress(OSError):  # the launcher has gone
            self._link.sendall(json.dumps(answer).encode() + b"\n")

    def _import(self, folders: Sequence[str], calls: Sequence[Sequence[str]]) -> None:
        """Import what forks need, from these folders before all others."""
        given = os.environ.get(_PYTHON_PATH, "")
        os.environ[_PYTHON_PATH] = os.pathsep.join([*folders, *([given] if given else [])])
        if not os.environ[_PYTHON_PATH]:
            del os.environ[_PYTHON_PATH]
        sys.path[:0] = folders
        for module, *function in calls:
            # What cannot be imported is reported by the node that needs it.
            with contextlib.suppress(Exception):
                found = importlib.import_module(module)
                if function:
                    getattr(found, function[0])(*function[1:])
        gc.collect()
        gc.freeze()  # the pages of what was imported stay shared

    def _start(
        self,
        command: list[str],
        log: str,
        folder: str,
        environment: dict[str, str],
        cores: list[int],
    ) -> None:
        """Start a process; the answer is its number, or the error."""
        module = command[len(python_command()) :]
        is_forked = self._can_show and command[: -len(module)] == python_command()
        is_forked = is_forked and _early(environment) == _early(os.environ)
        process = None
        try:
            with open(log, "ab") as output, children_on(cores):
                if is_forked:
                    pid = self._fork(output.fileno(), folder)
                else:
                    process = subprocess.Popen(
                        command,
                        stdin=subprocess.DEVNULL,
                        stdout=output,
                        stderr=output,
                        cwd=folder,
                        env=environment,
                        start_new_session=True,
                    )
                    pid = process.pid
        except (OSError, ValueError) as error:  # a null byte in the environment, for instance
            parts = getattr(error, "errno", None), getattr(error, "filename", None)
            self._answer(FAILED, parts[0], getattr(error, "strerror", None) or str(error), parts[1])
            return
        if pid == 0:
            os.environ.clear()
            os.environ.update(environment)
            show_as(command, environment)
            self.arguments = module
            return
        self._running[pid] = process
        self._answer(STARTED, pid)

    def _fork(self, output: int, folder: str) -> int:
        """Fork; in the fork, which gets 0, all is as if it had just been started."""
        os.chdir(folder)
        has_session, sets_session = os.pipe()
        try:
            pid = _fork_with_tracer()
        finally:
            os.chdir("/")
        if pid:
            os.close(sets_session)
            os.read(has_session, 1)  # its end: from now on signals reach the process group
            os.close(has_session)
            return pid
        os.setsid()
        os.chdir(folder)
        for descriptor in (1, 2):
            os.dup2(output, descriptor)
        signal.set_wakeup_fd(-1)
        for number in (*IGNORED, signal.SIGCHLD):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._link.close()
        locks = [descriptor for descriptor, _ in self.orders.locks]
        for descriptor in (self._woken, self._waker, has_session, sets_session, *locks):
            os.close(descriptor)
        if random := sys.modules.get("numpy.random"):  # Python's own generator does it by itself
            random.seed()
        gc.enable()
        return 0

    def _reap(self) -> None:
        """Answer which processes have ended; orphans of the run are children, too."""
        with contextlib.suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                if ended[0] not in self._running:
                    continue
                code = os.waitstatus_to_exitcode(ended[1])
                if process := self._running.pop(ended[0]):
                    process.returncode = code
                self._answer(ENDED, ended[0], code)
                if os.getppid() == self._launcher:
                    os.kill(self._launcher, signal.SIGCHLD)  # as children of its own do


def _fork_with_tracer() -> int:
    """``os.fork`` where ROS's libraries have loaded LTTng, whose threads a fork does not have.

    Without these calls, which LTTng offers for it, the fork would crash as it ends.
    """
    with open("/proc/self/maps") as maps:
        paths = {line.split(maxsplit=5)[-1].strip() for line in maps if "/liblttng-ust" in line}
    libraries = [ctypes.CDLL(path) for path in paths]
    # LTTng 2.13 has renamed them.
    tracers = [
        (library, prefix)
        for prefix in ("ust", "lttng_ust")
        for library in libraries
        if hasattr(library, f"{prefix}_before_fork")
    ]
    signals = ctypes.create_string_buffer(128)  # a sigset_t
    for library, prefix in tracers:
        library[f"{prefix}_before_fork"](signals)
    pid = os.fork()
    for library, prefix in tracers:
        library[f"{prefix}_after_fork_{'parent' if pid else 'child'}"](signals)
    return pid


def _early(environment: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in environment.items() if _READ_EARLY.fullmatch(name)}


@contextlib.contextmanager
def children_on(cores: Collection[int]) -> Iterator[None]:
    """Processes that this thread starts in this context get these cores, and all their threads.

    The mask counts from the first instruction of the child: for scripts, imports and the threads
    of DDS, too. An empty ``cores`` changes nothing. Raises ``OSError`` for a core that is absent.
    """
    before, itself = os.sched_getaffinity(0), os.getpid()
    if cores:
        os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        if cores and os.getpid() == itself:
            os.sched_setaffinity(0, before)


def clean_up(run_id: str, orders: Orders, alive: Callable[[], Collection[int]]) -> None:
    """End the processes of a run after its grace period, and remove its files."""

    def resume() -> None:
        for cleaner, argument in _cleaners(orders):
            cleaner.resume(argument, run_id)

    def left() -> set[int]:
        watched = {pid for pid, start in orders.watched.items() if start == started_at(pid)}
        return {*alive(), *watched}

    _end_all(left, orders.grace_s, resume)
    # Orders of a killed launcher, to an engine for instance, may still be under way.
    settle_s = 0.0 if orders.is_finished else _SETTLE_S
    for cleaner, argument in _cleaners(orders):
        cleaner.remove(argument, run_id, settle_s=settle_s, give_up_s=_REMOVE_S)
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


def _end_all(
    alive: Callable[[], Collection[int]], grace_s: float, resume: Callable[[], None]
) -> None:
    """Wait for all processes, and kill those that are left after the grace period.

    Paused nodes are resumed at once, so that they can end, and again when they are killed. What a
    killed process leaves comes to the guardian, and is killed in the next round.
    """
    now = time.monotonic()
    kill_at, give_up_at = now + grace_s, now + grace_s + KILL_DEADLINE_S
    pause_s = _POLL_S / 5
    resume_at = [now, kill_at]
    while (left := alive()) and time.monotonic() < give_up_at:
        if time.monotonic() >= kill_at:
            for pid in left:
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
    """Remove a lock file unless another run holds it, too, or has made a new one."""
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
