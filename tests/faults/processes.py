"""Faults of NeuROS's own processes, and of the Docker engine: {what} x {whom} x {when}."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
from engines import OwnEngine, own_engine
from launching import Running
from machines import Machine

from .cells import BACKENDS
from .trials import POLL_S, Expected, Outcome, Place, Trial, containers_of

SIGNALS = {
    "kill -9": signal.SIGKILL,
    "SIGTERM": signal.SIGTERM,
    "SIGSEGV": signal.SIGSEGV,
    "stopped for 2 s": signal.SIGSTOP,
}
TARGETS = ("launcher", "guardian", "recorder", "dashboard", "engine")
MOMENTS = {"starting": "import", "running": "function", "ending": "finalise"}
"""Where the run stands, and the place of a plugin that it stands at then."""

_DURATION_S = 2.0
_LONG_S = 20.0
_STOPPED_S = 2.0
_CLEANED_UP_WITHIN_S = 15.0
_COMES_UP_WITHIN_S = 5.0


@dataclass(frozen=True)
class ProcessFault:
    """A signal to one of the processes of a run at some moment."""

    signal: str
    target: str
    moment: str
    backend: str

    @property
    def place(self) -> Place:
        """Where it stands in the tables."""
        return Place(
            f"faults of other processes, {self.backend}",
            f"{self.target}: {self.signal}",
            self.moment,
        )

    def __str__(self) -> str:
        return str(self.place)

    @property
    def is_fatal(self) -> bool:
        """Whether its target dies of it at once."""
        return self.signal in ("kill -9", "SIGSEGV")

    @property
    def duration_s(self) -> float:
        """Of the run: one that ends with the fault must not end before, on a busy machine."""
        ends_it = self.target in ("launcher", "engine") and self.signal != "stopped for 2 s"
        return _LONG_S if ends_it and self.moment == "running" else _DURATION_S

    @property
    def expected(self) -> Expected:
        """The run goes on without sidecars and guardian, and ends with its launcher or engine."""
        if self.signal == "stopped for 2 s":
            return Expected(within_s=_DURATION_S + _STOPPED_S + 6.0)
        if self.target == "launcher" and self.is_fatal:
            code = -int(SIGNALS[self.signal])
            return Expected((code,), has_record=False, has_bag=self.moment != "starting")
        if self.target == "launcher" and self.moment == "ending":
            return Expected(says="SIGTERM: already ending")
        if self.target == "launcher":
            return Expected((143,), last_says="ended by SIGTERM")
        if self.target == "engine" and self.moment == "ending":
            return Expected(
                (0, 1, 4)
            )  # the nodes have been told to end, and need no engine for that
        if self.target == "engine":
            codes = (1, 4) if self.signal == "SIGTERM" else (4,)  # it ends its containers first
            says = "" if self.signal == "SIGTERM" else "the Docker engine "
            is_up = self.moment != "starting"
            return Expected(codes, last_says=says, has_record=is_up, has_bag=is_up)
        is_told = self.target == "guardian" and self.is_fatal
        says = "the guardian was killed: the launcher does its work" if is_told else ""
        return Expected(says=says, within_s=_DURATION_S + 6.0)


def process_faults() -> Iterator[ProcessFault]:
    """All of them."""
    for backend in BACKENDS:
        for target in TARGETS:
            if target != "engine" or backend == "docker":
                for name in SIGNALS:
                    for moment in MOMENTS:
                        yield ProcessFault(name, target, moment, backend)


def run(fault: ProcessFault, folder: Path) -> Outcome:
    """Let it strike a run in an empty folder, and judge what comes of that."""
    with _engine_of(fault) as engine:
        return _tried(fault, folder, engine)


def _tried(fault: ProcessFault, folder: Path, engine: OwnEngine | None) -> Outcome:
    at = "pass_by" if fault.moment == "running" else "dawdle"
    trial = Trial(folder, at, MOMENTS[fault.moment])
    address = {} if engine is None else {"DOCKER_HOST": engine.address}
    options = ["--dashboard"] if fault.target == "dashboard" else []
    with trial.start(fault.backend, *options, duration_s=fault.duration_s, **address) as running:
        trial.await_strike(running)
        struck_s = time.monotonic()
        if trial.struck_s is None:
            raise RuntimeError(f"{fault.place}: the run was over before that\n{running.output}")
        _strike(fault, trial, running, engine)

        def left() -> list[str]:
            if fault.backend != "docker":
                return []
            if engine is not None and fault.signal != "stopped for 2 s":
                engine.await_end()
                engine.start()
                _await_no_containers(folder, engine)
            return containers_of(folder, address.get("DOCKER_HOST"))

        return trial.outcome(fault.place, running, struck_s, fault.expected, is_left=left)


@contextlib.contextmanager
def _engine_of(fault: ProcessFault) -> Iterator[OwnEngine | None]:
    """An engine of its own for a fault that strikes it."""
    if fault.target != "engine":
        yield None
        return
    with contextlib.closing(Machine("engine")) as machine, own_engine(machine) as engine:
        yield engine


def _strike(fault: ProcessFault, trial: Trial, running: Running, engine: OwnEngine | None) -> None:
    if engine is not None:
        pid = engine.pid
    elif fault.target == "launcher":
        pid = running.process.pid
    else:
        pid = _pid_of(fault.target, trial)
    os.kill(pid, SIGNALS[fault.signal])
    if fault.signal == "stopped for 2 s":
        time.sleep(_STOPPED_S)
        os.kill(pid, signal.SIGCONT)


def _pid_of(target: str, trial: Trial) -> int:
    """The process that is, or is about to become, what it was started for."""
    until_s = time.monotonic() + _COMES_UP_WITHIN_S
    while time.monotonic() < until_s:
        for process in trial.processes():
            with contextlib.suppress(psutil.NoSuchProcess):
                if _is_target(process, target):
                    return int(process.pid)
        time.sleep(POLL_S)
    raise RuntimeError(f"no {target} has come up")


def _is_target(process: psutil.Process, target: str) -> bool:
    if target == "guardian":
        return "guardian_program" in " ".join(process.cmdline())
    return process.cmdline()[4:5] == [target]


def _await_no_containers(folder: Path, engine: OwnEngine) -> None:
    """An engine that comes back finds out by and by which containers have ended meanwhile."""
    until_s = time.monotonic() + _CLEANED_UP_WITHIN_S
    while containers_of(folder, engine.address) and time.monotonic() < until_s:
        time.sleep(0.1)
