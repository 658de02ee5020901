"""``neuros launch``: from a project file to a run folder and an exit code."""

from __future__ import annotations

import argparse
import json
import os
import re
import secrets
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from neuros.cli.console import Console
from neuros.cli.projects import WORKSPACE, load
from neuros.control import SOCKET_NAME
from neuros.errors import EnvironmentFault, Problem, ProjectError, UsageError
from neuros.launch.domain import DomainLock, choose_domain
from neuros.launch.guardian import Guardian
from neuros.launch.in_process import InProcessLauncher
from neuros.launch.outcome import Outcome
from neuros.launch.process import ProcessLauncher
from neuros.launch.supervisor import Supervisor
from neuros.observe.report import run_record, run_table
from neuros.ports import Launcher
from neuros.project.model import Folders, NodeFile, Project
from neuros.project.split import node_file_to_json, project_to_json, split
from neuros.project.validate import nest_conflicts

_ENDED_BY_SIGNAL = (130, 143)
_PATIENCE_S = 1.0


@dataclass(frozen=True)
class Duration:
    """What ``--duration`` says: wall seconds, or simulated seconds."""

    wall_s: float | None = None
    sim_s: float | None = None


def launch(options: argparse.Namespace) -> int:
    """Run a project; returns the exit code."""
    with _signals_noted() as signals:
        duration = parse_duration(options.duration)
        project = load(options)
        backend = choose_backend(options.backend)
        names = _chosen_names(project, options.node, backend)
        _check(project, names, backend, duration)
        if not options.dry_run:
            _check_machine()
        is_partial = len(names) < len(project.nodes)
        with ExitStack() as stack:
            domain = stack.enter_context(
                choose_domain(
                    options.domain_id, os.environ, _needs_known_domain(project, is_partial)
                )
            )
            if options.dry_run:
                return _dry_run(project, names, backend, duration, domain, options)
            run_folder = make_run_folder(options.output, project.name)
            files = _write_node_files(project, names, run_folder)
            run = _Run(
                project, files, backend, duration, domain, run_folder, is_partial, options, signals
            )
            return run.execute()


class _Run:
    """One run of a project."""

    def __init__(
        self,
        project: Project,
        files: Sequence[NodeFile],
        backend: str,
        duration: Duration,
        domain: DomainLock,
        run_folder: Path,
        is_partial: bool,
        options: argparse.Namespace,
        signals: list[int],
    ) -> None:
        self._project = project
        self._files = files
        self._backend = backend
        self._duration = duration
        self._domain = domain
        self._run_folder = run_folder
        self._is_partial = is_partial
        self._options = options
        self._run_id = secrets.token_hex(8)
        logs = {file.node.name: run_folder / file.node.name / "node.log" for file in files}
        if backend == "in-process":
            logs["host"] = run_folder / "host.log"
        self._signals = signals
        self._console = Console(logs, lambda: bool(signals))

    def execute(self) -> int:
        """Start, supervise, clean up, report."""
        started, started_s = time.time(), time.monotonic()
        guardian = Guardian.start(self._run_id, self._domain)
        guardian.remove_later(self._run_folder / SOCKET_NAME)
        outcome = Outcome(exit_code=1, reason="the launcher failed", ended_s=started_s)
        try:
            self._console.log("INFO", f"{self._domain.reason}; run folder {self._run_folder}")
            supervisor = self._supervisor(guardian)
            outcome = supervisor.outcome
            supervisor.run()
        finally:
            guardian.finish()
            # Whoever has ended the run is not made to wait for a reader that does not read.
            self._console.finish(_PATIENCE_S if outcome.is_signalled else None)
            wall_s = outcome.ended_s - (outcome.started_s or started_s)
            record = run_record(self._project, self._files, outcome, wall_s)
            record |= {"backend": self._backend, "domain_id": self._domain.id, "started": started}
            self._write_record(record)
        self._console.write("\n" + run_table(record) + "\n")
        for reason in outcome.failures:
            if reason != outcome.reason:
                self._console.log("ERROR", reason)
        is_good = outcome.exit_code in (0, *_ENDED_BY_SIGNAL)
        self._console.log("INFO" if is_good else "ERROR", outcome.reason)
        return outcome.exit_code

    def _supervisor(self, guardian: Guardian) -> Supervisor:
        return Supervisor(
            self._files,
            make_launcher(self._backend, self._duration, self._options.verbose, guardian.watch),
            self._environment(),
            self._run_folder,
            self._console,
            self._signals,
            duration_s=self._duration.wall_s,
            is_partial=self._is_partial,
        )

    def _write_record(self, record: Mapping[str, Any]) -> None:
        try:
            (self._run_folder / "run.json").write_text(json.dumps(record, indent=2) + "\n")
        except OSError as error:
            self._console.log("ERROR", f"run.json cannot be written: {error.strerror}")

    def _environment(self) -> dict[str, str]:
        return {
            "NEUROS_RUN_ID": self._run_id,
            "ROS_DOMAIN_ID": str(self._domain.id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": os.environ.get(
                "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"
            ),
            "ROS_LOG_DIR": str(self._run_folder),
        }


def parse_duration(text: str | None) -> Duration:
    """``30``, ``0.5``, or ``30sim``.

    Raises:
        UsageError: for anything else.
    """
    if text is None:
        return Duration()
    match = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)(sim)?", text.strip())
    if match is None or float(match[1]) <= 0:
        raise UsageError(f"--duration {text}: give seconds, as 30, or 30sim for simulated time")
    seconds = float(match[1])
    return Duration(sim_s=seconds) if match[2] else Duration(wall_s=seconds)


def choose_backend(wanted: str) -> str:
    """The back end for ``--backend``.

    Raises:
        UsageError: for one that does not exist yet.
    """
    if wanted == "docker":
        raise UsageError("--backend docker: not there yet; use process or in-process")
    return "process" if wanted == "auto" else wanted


def make_launcher(
    backend: str, duration: Duration, verbose: bool, on_started: Callable[[int], None] | None = None
) -> Launcher:
    """The launcher of a back end."""
    command = [sys.executable, "-m", "neuros.cli", "node"]
    if duration.sim_s is not None:
        command += ["--duration-sim", repr(duration.sim_s)]
    if verbose:
        command.append("--debug")
    if backend == "in-process":
        return InProcessLauncher([*command, "--in-memory"], on_started)
    return ProcessLauncher(command, on_started)


def make_run_folder(output: str | None, project_name: str) -> Path:
    """Create the folder of a run.

    Raises:
        UsageError: if it exists and is not empty, or cannot be created.
    """
    if output is None:
        stamp = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H-%M-%S.%fZ")
        folder = Path.cwd() / "runs" / project_name / stamp
    else:
        folder = Path(output).absolute()
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"-o {output}: is not an empty folder; name a new one")
    try:
        folder.mkdir(parents=True, exist_ok=output is not None)
    except OSError as error:
        raise UsageError(
            f"the run folder {folder} cannot be made ({error.strerror}): name one with -o"
        ) from error
    return folder


def _write_node_files(project: Project, names: Sequence[str], run_folder: Path) -> list[NodeFile]:
    folders = Folders(project.folder, WORKSPACE, run_folder)
    files = [file for file in split(project, lambda _: folders) if file.node.name in names]
    try:
        # Two runs that were given the same empty folder: only one of them gets it.
        with open(run_folder / "project.json", "x", encoding="utf-8") as expanded:
            expanded.write(json.dumps(project_to_json(project), indent=2) + "\n")
        for file in files:
            (run_folder / file.node.name).mkdir(exist_ok=True)
            text = json.dumps(node_file_to_json(file), indent=2) + "\n"
            (run_folder / file.node.name / "node.json").write_text(text, "utf-8")
    except FileExistsError as error:
        raise UsageError(
            f"{run_folder}: another run has just begun there; name a new one"
        ) from error
    except OSError as error:
        raise UsageError(
            f"{run_folder} cannot be written to ({error.strerror}): name another folder with -o"
        ) from error
    return files


def _chosen_names(project: Project, wanted: Sequence[str], backend: str) -> list[str]:
    known = [node.name for node in project.nodes]
    for name in wanted:
        if name not in known:
            raise UsageError(f"-n {name}: no such node; the project has {', '.join(known)}")
    chosen = [name for name in known if not wanted or name in wanted]
    if backend == "in-process":
        for connection in project.connections:
            ends = (connection.source_node, connection.destination_node)
            if len({name for name in ends if name in chosen}) == 1 and len(set(ends)) == 2:
                raise UsageError(
                    f"-n leaves out one end of {connection}, which the in-process back end"
                    " cannot reach; use --backend process"
                )
    return chosen


def _check(project: Project, names: Sequence[str], backend: str, duration: Duration) -> None:
    problems: list[Problem] = []
    if backend == "in-process":
        problems += nest_conflicts(project)
    if duration.sim_s is not None:
        owners = [node.name for node in project.nodes if node.owns_time and node.name in names]
        if len(owners) != 1:
            found = ", ".join(owners) or "none"
            problems.append(
                Problem(
                    str(project.file),
                    1,
                    1,
                    "/nodes",
                    f"--duration in simulated time needs exactly one node that owns time: {found}",
                    "a node owns time if a port of it has mujoco, or its output is a Clock",
                )
            )
    if problems:
        raise ProjectError(problems)


def _check_machine() -> None:
    if find_spec("rclpy") is None:
        raise EnvironmentFault(
            f"rclpy, the Python library of ROS 2, is not installed for {sys.executable}: run"
            " install.py"
        )


def _needs_known_domain(project: Project, is_partial: bool) -> bool:
    ports = (port for node in project.nodes for port in (*node.inputs, *node.outputs))
    return is_partial or any(port.external_topic is not None for port in ports)


def _dry_run(
    project: Project,
    names: Sequence[str],
    backend: str,
    duration: Duration,
    domain: DomainLock,
    options: argparse.Namespace,
) -> int:
    folder = Path(options.output or f"runs/{project.name}/<utc time>").absolute()
    folders = Folders(project.folder, WORKSPACE, folder)
    files = [file for file in split(project, lambda _: folders) if file.node.name in names]
    print(f"back end {backend}; {domain.reason}; run folder {folder}")
    for line in make_launcher(backend, duration, options.verbose).describe(files):
        print(line)
    return 0


@contextmanager
def _signals_noted() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM instead of dying of them, until the run is cleaned up."""
    noted: list[int] = []
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # else nohup wants it to go on
        numbers.append(signal.SIGHUP)
    previous = {
        number: signal.signal(number, lambda number, _: noted.append(number)) for number in numbers
    }
    try:
        yield noted
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
