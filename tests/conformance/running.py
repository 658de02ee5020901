"""Runs a project on a real back end and gathers what its nodes have observed."""

from __future__ import annotations

import bisect
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neuros.api.live import LiveRun
from neuros.api.project import _project_of
from neuros.backends.domain import choose_domain
from neuros.errors import NeurosError

from .description import Project

LONGEST_S = 30.0
"""After so long a run that has not ended by itself is ended, and judged as one that did not."""

LOCAL, WITHOUT_ROS = "local", "no-ros"
"""A session that runs freely, in a program of its own; in process, with ``--no-ros``."""

_BACK_ENDS: Mapping[str, Mapping[str, Any]] = {
    WITHOUT_ROS: {"backend": "in-process", "backend_options": {"ros": False}}
}
_ROOT = Path(__file__).parents[2]
_UNBEGUN_S = 6.0
_PATIENCE_S = 15.0
_POLL_S = 0.02


@dataclass(frozen=True)
class Execution:
    """A line of a node's log.

    Attributes:
        taken: by input, the packets by connection: ``(origin, number, is_intact)``; ``None`` where
            an ``Optional`` input had none.
        sent: the number of the packet by output.
    """

    node: str
    hook: str
    start_ns: int
    end_ns: int
    taken: list[list[tuple[int, int, bool] | None] | None]
    sent: Mapping[str, int]


@dataclass
class Observed:
    """A run as its nodes, its launcher and this machine saw it; times on the monotonic clock.

    Attributes:
        executions: by node, in the order of its log; finalise hooks, too.
        loaded_ns: when each plugin was imported.
        record: the content of ``run.json``, empty if there is none.
        ending_ns: when the end was asked for, at the earliest; ``None``: it was not, from outside.
        ended_ns: when the launcher was done.
        late_ns: by how much this machine wakes up late at worst.
        left: what has outlived the run.
        is_overdue: whether the run had to be ended.
    """

    backend: str
    executions: dict[str, list[Execution]] = field(default_factory=dict)
    loaded_ns: dict[str, int] = field(default_factory=dict)
    record: Mapping[str, Any] = field(default_factory=dict)
    ending_ns: int | None = None
    ended_ns: int = 0
    late_ns: int = 0
    left: list[str] = field(default_factory=list)
    is_overdue: bool = False
    error: str = ""
    logs: dict[str, str] = field(default_factory=dict)

    @property
    def is_one_process(self) -> bool:
        """Whether nodes took turns in one thread."""
        return self.backend not in ("process", "docker")

    @property
    def looks_for_deadlocks(self) -> bool:
        """Whether a deadlock ends the run; the program that holds a session decides for itself."""
        return self.backend != LOCAL

    @property
    def exit_code(self) -> int:
        return int(self.record.get("exit_code", -1))

    @property
    def reason(self) -> str:
        return str(self.record.get("reason", ""))

    def connection(self, name: str) -> Mapping[str, Any] | None:
        """What ``run.json`` says of a connection."""
        found = [c for c in self.record.get("connections", ()) if c["connection"] == name]
        return found[0] if found else None


class LoadMeter:
    """Measures how late this machine wakes up who sleeps, all the time, in a thread of its own."""

    _PERIOD_S = 0.005

    def __init__(self) -> None:
        self._ends: list[int] = []
        self._late: list[int] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._measure, daemon=True)

    def __enter__(self) -> LoadMeter:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def worst_ns(self, since_ns: int) -> int:
        """The longest delay since then."""
        return max(self._late[bisect.bisect(self._ends, since_ns) :], default=0)

    def _measure(self) -> None:
        while not self._stop.is_set():
            before_ns = time.monotonic_ns()
            time.sleep(self._PERIOD_S)
            now_ns = time.monotonic_ns()
            self._late.append(now_ns - before_ns - int(self._PERIOD_S * 1e9))
            self._ends.append(now_ns)


def run(project: Project, backend: str, meter: LoadMeter, *, seconds: float = 0.0) -> Observed:
    """Run a project in a temporary folder.

    Args:
        seconds: in place of the project's own.
    """
    with tempfile.TemporaryDirectory(prefix="neuros-conformance-") as folder:
        return run_in(Path(folder), project, backend, meter, seconds=seconds)


def run_in(
    folder: Path, project: Project, backend: str, meter: LoadMeter, *, seconds: float = 0.0
) -> Observed:
    """The same in a folder that stays."""
    file, run_folder = project.write(folder), folder / "run"
    seconds = seconds or project.seconds
    observed = Observed(backend)
    begin_ns = time.monotonic_ns()
    duration = seconds if project.end == "duration" else None
    # Projects with external topics would all go to domain 0, and hear each other.
    with choose_domain(None, {}, False) as domain:
        try:
            live: LiveRun | _Program
            if backend == LOCAL:
                live = _Program(file, run_folder, duration or 2 * LONGEST_S, domain.id)
            else:
                named = _BACK_ENDS.get(backend, {"backend": backend})
                live = _project_of(file, {}).start(
                    duration=duration, output=run_folder, domain_id=domain.id, **named
                )
            _wait(live, project, run_folder, seconds, observed)
        except NeurosError as error:
            observed.error = str(error)
            return observed
    observed.ended_ns = time.monotonic_ns()
    observed.late_ns = meter.worst_ns(begin_ns)
    observed.left = _left(run_folder)
    _read(run_folder, project, observed)
    if duration and observed.ending_ns is None:
        observed.ending_ns = earliest_start_ns(project, observed) + int(duration * 1e9)
    return observed


class _Program:
    """The program ``session_program``, which looks like a run that was launched."""

    def __init__(self, file: Path, folder: Path, seconds: float, domain: int) -> None:
        command = [sys.executable, "-m", "tests.conformance.session_program"]
        self._log = file.with_name("program.log")
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [*command, str(file), str(folder), str(seconds)],
                env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
                cwd=_ROOT,
                stderr=log,
            )

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    def interrupt(self) -> None:
        self._process.send_signal(signal.SIGINT)

    def wait(self, timeout_s: float) -> None:
        """Wait for its end. Raises ``TimeoutError``."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise TimeoutError from None

    def kill(self) -> str:
        """End it by force; returns where it stood."""
        self._process.send_signal(signal.SIGABRT)
        self._process.wait()
        return self._log.read_text()


def _wait(
    live: LiveRun | _Program, project: Project, run_folder: Path, seconds: float, observed: Observed
) -> None:
    """Until it has ended, by itself or since it was interrupted some time after its first hook.

    That hook may wait for an external topic to bring something, and so perhaps for ever.
    """
    deadline_s = time.monotonic() + LONGEST_S
    if project.end == "interrupt":
        unbegun_s = time.monotonic() + _UNBEGUN_S
        while live.is_running and time.monotonic() < unbegun_s and not _has_begun(run_folder):
            time.sleep(_POLL_S)
        if not _has_ended(live, seconds):
            observed.ending_ns = time.monotonic_ns()
            live.interrupt()
    if not _has_ended(live, max(_PATIENCE_S, deadline_s - time.monotonic())):
        observed.is_overdue = True
        observed.ending_ns = observed.ending_ns or time.monotonic_ns()
        live.interrupt()
    if isinstance(live, _Program) and not _has_ended(live, LONGEST_S):
        observed.error = f"it does not end:\n{live.kill()}"
    live.wait(LONGEST_S)


def _has_ended(live: LiveRun | _Program, within_s: float) -> bool:
    with contextlib.suppress(TimeoutError):
        live.wait(within_s)
    return not live.is_running


def _has_begun(run_folder: Path) -> bool:
    """Whether some hook has run: the first line of a log tells of the import."""
    return any(file.read_bytes().count(b"\n") > 1 for file in run_folder.glob("*/observed.jsonl"))


def _read(run_folder: Path, project: Project, observed: Observed) -> None:
    with contextlib.suppress(OSError, ValueError):
        observed.record = json.loads((run_folder / "run.json").read_text())
    for node in project.nodes:
        file = run_folder / node.name / "observed.jsonl"
        log = run_folder / node.name / "node.log"
        if log.exists():
            observed.logs[node.name] = log.read_text("utf-8", "replace")
        if not file.exists():
            continue
        observed.executions[node.name] = []
        for line in file.read_text().splitlines():
            hook, start_ns, end_ns, taken, sent = json.loads(line)
            if hook:
                execution = Execution(node.name, hook, start_ns, end_ns, taken, sent)
                observed.executions[node.name].append(execution)
            else:
                observed.loaded_ns[node.name] = start_ns


def earliest_start_ns(project: Project, observed: Observed) -> int:
    """Time 0 of the run, or before: by then every node is loaded, and has initialised.

    A node whose initialise hooks take packets may need those of others for that.
    """
    times = [*observed.loaded_ns.values()]
    for name, log in observed.executions.items():
        hooks = [hook for hook in project.by_name[name].hooks if hook.kind == "initialise"]
        if not any(hook.inputs for hook in hooks):
            names = {hook.name for hook in hooks}
            times += [each.end_ns for each in log if each.hook in names]
    return max(times, default=0)


def _left(run_folder: Path) -> list[str]:
    """Processes that work in the run folder, and files that were for the run alone."""
    deadline_s = time.monotonic() + 5.0
    while (found := [*_processes(run_folder)]) and time.monotonic() < deadline_s:
        time.sleep(_POLL_S)
    sockets = (str(file) for file in run_folder.rglob("*") if file.is_socket())
    return [*found, *sockets]


def _processes(run_folder: Path) -> Iterator[str]:
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if Path(os.readlink(entry / "cwd")).is_relative_to(run_folder):
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                yield f"process {entry.name}: {command.strip()}"
