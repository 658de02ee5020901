"""Faults around a run: its terminal, its disks, its limits, its clock, and a machine that stops."""

from __future__ import annotations

import contextlib
import os
import pty
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from launching import Running
from machines import Machine

from .trials import ENDS_WITHIN_S, Expected, Outcome, Place, Trial, containers_of, read_to_end

_DURATION_S = 2.0
_SUSPENDED_S = 10.0
_DISK = "8m"
_PRINTED_BYTES = 12 << 20
_HOUR_S = 3600
_CLOCK_SOURCE = Path(__file__).parent / "stepped_clock.c"
_NOBODY = 54321
# It leads its session already; the terminal on its standard input becomes that of the session.
_IN_TERMINAL = """
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.dup2(0, 1)
os.dup2(0, 2)
os.execvp(sys.argv[1], sys.argv[1:])
"""
_BOTH = ("process", "in-process")
_ALL = ("process", "in-process", "docker")


@dataclass(frozen=True)
class Surrounding:
    """Something that befalls a run from outside.

    Attributes:
        name: as the table shows it.
        run: brings a run into it, in an empty folder.
        backends: those to which it can happen.
    """

    name: str
    expected: Expected
    run: Callable[[Surrounding, str, Path], Outcome]
    backends: Sequence[str] = _BOTH

    def place(self, backend: str) -> Place:
        """Where it stands in the tables."""
        return Place("surroundings", self.name, backend)


@dataclass(frozen=True)
class SurroundingCell:
    """A surrounding on a back end."""

    surrounding: Surrounding
    backend: str

    @property
    def place(self) -> Place:
        """Where it stands in the tables."""
        return self.surrounding.place(self.backend)

    def __str__(self) -> str:
        return str(self.place)


def surroundings() -> Iterator[SurroundingCell]:
    """All of them."""
    for each in _SURROUNDINGS:
        for backend in each.backends:
            yield SurroundingCell(each, backend)


def run(cell: SurroundingCell, folder: Path) -> Outcome:
    """Run a project in an empty folder, in such surroundings, and judge what comes of that."""
    return cell.surrounding.run(cell.surrounding, cell.backend, folder)


# ------------------------------------------------------------------ terminal and output


def _close_terminal(self: Surrounding, backend: str, folder: Path) -> Outcome:
    """The window of a terminal is closed: whoever leads its session gets SIGHUP."""
    trial = Trial(folder, "pass_by", "function")
    master, slave = pty.openpty()
    through = [sys.executable, "-S", "-c", _IN_TERMINAL]
    with open(slave, "rb") as terminal:
        running = trial.start(backend, duration_s=30.0, through=through, stdin=terminal)
    with running:
        trial.await_strike(running)
        struck_s = time.monotonic()
        os.close(master)
        return _outcome(self, backend, trial, running, struck_s)


def _close_reader(self: Surrounding, backend: str, folder: Path) -> Outcome:
    """``neuros launch ... | head -1``."""
    trial = Trial(folder, "pass_by", "function")
    with trial.start(backend, duration_s=_DURATION_S) as running:
        running.wait_for("\n")
        assert running.process.stdout is not None
        running.process.stdout.close()
        struck_s = trial.await_strike(running)
        return _outcome(self, backend, trial, running, struck_s)


def _close_streams(self: Surrounding, backend: str, folder: Path) -> Outcome:
    """``neuros launch ... <&- >&- 2>&-``, as a service might be started."""
    trial = Trial(folder, "pass_by", "function")
    through = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh"]
    with trial.start(backend, duration_s=_DURATION_S, through=through) as running:
        struck_s = trial.await_strike(running)
        return _outcome(self, backend, trial, running, struck_s)


# ------------------------------------------------------------------ disks


def _full_before(self: Surrounding, backend: str, folder: Path) -> Outcome:
    with _small_disk(folder / "disk") as disk:
        _fill(disk)
        trial = Trial(folder, "pass_by", "function", run_folder=disk / "run")
        with trial.start(backend, duration_s=_DURATION_S) as running:
            return _outcome(self, backend, trial, running, time.monotonic())


def _full_at(strikes_at: str) -> Callable[[Surrounding, str, Path], Outcome]:
    """A plugin prints more than there is room for."""

    def run(self: Surrounding, backend: str, folder: Path) -> Outcome:
        with _small_disk(folder / "disk") as disk:
            trial = Trial(folder, "print_much", strikes_at, _PRINTED_BYTES, disk / "run")
            # Also a source that starts late has to have sent what finds no room in the bag.
            with trial.start(backend, duration_s=2 * _DURATION_S) as running:
                struck_s = trial.await_strike(running)
                read_to_end(running, struck_s + 20.0)
                # A user makes room, and finds ``run.json`` where the run has said.
                (trial.run_folder / "victim" / "node.log").unlink()
                for spare in trial.temporary.glob("neuros-*"):
                    shutil.copy(spare / "run.json", folder / "spare.json")
                    shutil.rmtree(spare)
                outcome = _outcome(self, backend, trial, running, struck_s)
            if not (folder / "spare.json").exists() and not outcome.record:
                outcome.problems.append("no run.json anywhere")
            if (found := running.output.count("No space left on device")) > 7:
                outcome.problems.append(f"says {found} times that there is no space")
            return outcome

    return run


def _full_shared_memory(self: Surrounding, backend: str, folder: Path) -> Outcome:
    return _apart(self, backend, folder, "mount -t tmpfs -o size=64k tmpfs /dev/shm")


def _temporary(inodes: int) -> Callable[[Surrounding, str, Path], Outcome]:
    """No room in the temporary folder, and so many inodes, three of which are in use.

    Domains are locked there: with its own network, this run meets no other all the same.
    """
    full = (
        f"mount -t tmpfs -o size=4k,nr_inodes={inodes} tmpfs /tmp && echo >/tmp/1 && touch /tmp/2"
    )

    def run(self: Surrounding, backend: str, folder: Path) -> Outcome:
        with _elsewhere() as other:
            return _apart(self, backend, other, full, TMPDIR="/tmp")

    return run


def _apart(
    self: Surrounding, backend: str, folder: Path, prepare: str, **environment: str
) -> Outcome:
    """Run with mounts and a network of its own; they go with the last process of the run."""
    trial = Trial(folder, "pass_by", "function")
    prepare = f'ip link set lo up && {prepare} && exec "$@"'
    through = ["unshare", "--mount", "--net", "sh", "-c", prepare, "sh"]
    with trial.start(backend, duration_s=_DURATION_S, through=through, **environment) as running:
        struck_s = trial.await_strike(running)
        return _outcome(self, backend, trial, running, struck_s)


@contextlib.contextmanager
def _small_disk(folder: Path) -> Iterator[Path]:
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={_DISK}", "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


def _fill(disk: Path) -> None:
    with contextlib.suppress(OSError), open(disk / "filler", "wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 12))


@contextlib.contextmanager
def _elsewhere() -> Iterator[Path]:
    """A folder that is not below ``/tmp``."""
    with tempfile.TemporaryDirectory(dir="/var/tmp") as folder:
        yield Path(folder)


# ------------------------------------------------------------------ limits


def _limited(limit: str) -> Callable[[Surrounding, str, Path], Outcome]:
    def run(self: Surrounding, backend: str, folder: Path) -> Outcome:
        trial = Trial(folder, "pass_by", "function")
        with trial.start(backend, duration_s=_DURATION_S, through=["prlimit", limit]) as running:
            struck_s = trial.await_strike(running)
            return _outcome(self, backend, trial, running, struck_s)

    return run


def _as_another_user(*through: str) -> Callable[[Surrounding, str, Path], Outcome]:
    """Another user launches, who has limits that root has not, but may read what root installed."""
    user = ["setpriv", f"--reuid={_NOBODY}", f"--regid={_NOBODY}", "--clear-groups"]
    user += ["--inh-caps=+dac_override", "--ambient-caps=+dac_override"]

    def run(self: Surrounding, backend: str, folder: Path) -> Outcome:
        with _elsewhere() as other:
            trial = Trial(other, "pass_by", "function")
            home = other / "home"
            home.mkdir()
            for path in (other, trial.temporary, home):
                os.chown(path, _NOBODY, _NOBODY)
            with trial.start(
                backend, duration_s=_DURATION_S, through=[*user, *through], HOME=str(home)
            ) as running:
                struck_s = trial.await_strike(running)
                return _outcome(self, backend, trial, running, struck_s)

    return run


# ------------------------------------------------------------------ clock, and standing still


def _stepped_clock(step_s: int) -> Callable[[Surrounding, str, Path], Outcome]:
    """The clock is wrong at first, and is then set right, by so many seconds; a node is killed.

    For shared memory of a killed node is told from that of others by its age. Other runs of this
    machine would clean up after it, so this one has shared memory to itself.
    """

    def run(self: Surrounding, backend: str, folder: Path) -> Outcome:
        trial = Trial(folder, "kill_later", "function")
        ahead = folder / "clock_ahead_s"
        ahead.write_bytes((-step_s).to_bytes(8, "little", signed=True))
        library = folder / "stepped_clock.so"
        command = ["gcc", "-shared", "-fPIC", "-O2", "-o", str(library), str(_CLOCK_SOURCE)]
        subprocess.run([*command, "-ldl"], check=True)
        clock = {"LD_PRELOAD": str(library), "CLOCK_AHEAD": str(ahead)}
        with contextlib.closing(Machine("clock")) as machine:
            machine.run("mount", "-t", "tmpfs", "tmpfs", "/dev/shm")
            shared_memory = Path(f"/proc/{machine.pid}/root/dev/shm")
            through = machine.inside(folder)
            with trial.start(backend, duration_s=_DURATION_S, through=through, **clock) as running:
                struck_s = trial.await_strike(running)
                with open(ahead, "r+b") as file:
                    file.write(bytes(8))
                outcome = _outcome(self, backend, trial, running, struck_s)
            left = [path.name for path in shared_memory.iterdir()]
            outcome.problems += [f"left: {each}" for each in left if "lttng" not in each]
            return outcome

    return run


def _suspended_at(strikes_at: str) -> Callable[[Surrounding, str, Path], Outcome]:
    """All processes of the run stand still for some seconds, as on a machine that is paused."""

    def run(self: Surrounding, backend: str, folder: Path) -> Outcome:
        fault = "dawdle" if strikes_at == "finalise" else "pass_by"
        trial = Trial(folder, fault, strikes_at)
        duration_s = _DURATION_S + (0.0 if strikes_at == "finalise" else _SUSPENDED_S)
        with trial.start(backend, duration_s=duration_s) as running:
            trial.await_strike(running)
            numbers = [process.pid for process in trial.processes()]
            assert running.process.pid in numbers
            try:
                _signal_all(numbers, signal.SIGSTOP)
                time.sleep(_SUSPENDED_S)
            finally:
                _signal_all(numbers, signal.SIGCONT)
            outcome = _outcome(self, backend, trial, running, time.monotonic())
        warnings = [line for line in running.output.splitlines() if line.startswith("[WARN]")]
        outcome.problems += [f"warns: {line}" for line in warnings]
        return outcome

    return run


def _signal_all(processes: Sequence[int], number: int) -> None:
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, number)


def _outcome(
    self: Surrounding, backend: str, trial: Trial, running: Running, due_s: float
) -> Outcome:
    def left() -> list[str]:
        return containers_of(trial.folder) if backend == "docker" else []

    return trial.outcome(self.place(backend), running, due_s, self.expected, is_left=left)


_GOES_ON = Expected(within_s=_DURATION_S + ENDS_WITHIN_S)
_UNSEEN = replace(_GOES_ON, has_traceback=None)
_SURROUNDINGS = (
    Surrounding("terminal closed", Expected((143,), has_traceback=None), _close_terminal, _ALL),
    Surrounding("reader of the output gone", _UNSEEN, _close_reader, _ALL),
    Surrounding("standard streams closed", _UNSEEN, _close_streams, _ALL),
    Surrounding(
        "run folder full before",
        Expected((2,), last_says="No space left on device", has_record=False, has_bag=False),
        _full_before,
        _ALL,
    ),
    Surrounding(
        "run folder full while running",
        Expected((1,), last_says="OSError: [Errno 28] No space left on device", has_record=False),
        _full_at("function"),
        _ALL,
    ),
    Surrounding(
        "run folder full while ending",
        Expected((0, 1, 4), has_record=False),  # the recorder may have made room
        _full_at("finalise"),
        _ALL,
    ),
    Surrounding("shared memory full", _GOES_ON, _full_shared_memory),
    Surrounding("temporary folder full", _GOES_ON, _temporary(inodes=100)),
    Surrounding(
        "temporary folder without inodes",
        Expected((4,), last_says="No space left on device", has_record=False, has_bag=False),
        _temporary(inodes=3),
    ),
    Surrounding("64 file descriptors", _GOES_ON, _limited("--nofile=64")),
    Surrounding("256 file descriptors", _GOES_ON, _limited("--nofile=256")),
    Surrounding(
        "8 processes and threads",
        Expected((1, 4), within_s=20.0, has_record=False, has_bag=False, has_traceback=None),
        _as_another_user("prlimit", "--nproc=8"),
    ),
    Surrounding("lowest priority", _GOES_ON, _as_another_user("nice", "-n", "19")),
    Surrounding(
        "clock set back by an hour", Expected((1,), last_says="victim"), _stepped_clock(-_HOUR_S)
    ),
    Surrounding(
        "clock set forward by an hour", Expected((1,), last_says="victim"), _stepped_clock(_HOUR_S)
    ),
    Surrounding("stopped for 10 s while running", _GOES_ON, _suspended_at("function"), _ALL),
    Surrounding("stopped for 10 s while ending", Expected(), _suspended_at("finalise"), _ALL),
)
