"""``neuros launch``: runs a plan from its first process to its exit code."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from neuros.cli.console import Console
from neuros.cli.environments import make_environments
from neuros.cli.observation import Observation, check_observation
from neuros.cli.plan import Plan, make_plan
from neuros.cli.recording import Recording, log_of, plan_of, summary
from neuros.cli.run_folder import (
    folders_of,
    make_run_folder,
    run_folder_path,
    write_node_files,
    write_record,
)
from neuros.cli.views import Shown, Views
from neuros.control import SOCKET_NAME
from neuros.errors import EnvironmentFault
from neuros.launch.domain import DomainLock, choose_domain
from neuros.launch.guardian import Guardian
from neuros.launch.host_command import with_messages
from neuros.launch.outcome import Outcome
from neuros.launch.sessions import Session, guardian_environment, this_process
from neuros.launch.sides import Sides
from neuros.launch.supervisor import Supervisor
from neuros.observe.budgets import broken_budgets
from neuros.observe.recording.plan import RecordingPlan
from neuros.observe.report import run_record, run_table
from neuros.project.model import NodeFile
from neuros.runtime.side import ELSEWHERE_VARIABLE

EXIT_ENVIRONMENT, EXIT_BUDGET = 4, 5
_ENDED_BY_SIGNAL = (130, 143)
_PATIENCE_S = 1.0


def launch(options: argparse.Namespace) -> int:
    """Run a project; returns the exit code."""
    with _signals_noted() as (signals, waker):
        plan = make_plan(options)
        recording = plan_of(options, plan, os.environ)
        is_known = plan.needs_known_domain or bool(recording and recording.wanted)
        if not options.dry_run and (
            ended := make_environments(plan.pythons, signals, plan.messages)
        ):
            return ended
        with choose_domain(options.domain_id, os.environ, is_known) as domain:
            if options.dry_run:
                return _dry_run(plan, domain, options.output, recording)
            check_observation(options)
            views = Views(options, plan)
            run_folder = make_run_folder(options.output, plan.project.name)
            files = write_node_files(plan, run_folder)
            run = _Run(plan, files, domain, run_folder, signals, waker, recording, views)
            return run.execute(options)


class _Run:
    """One run of a plan."""

    def __init__(
        self,
        plan: Plan,
        files: list[NodeFile],
        domain: DomainLock,
        run_folder: Path,
        signals: list[int],
        waker: socket.socket,
        recording: RecordingPlan | None,
        views: Views,
    ) -> None:
        self._plan = plan
        self._views = views
        self._files = files
        self._domain = domain
        self._run_folder = run_folder
        self._signals = signals
        self._waker = waker
        self._run_id = os.urandom(8).hex()
        logs = {file.node.name: run_folder / file.node.name / "node.log" for file in files}
        if plan.backend == "in-process":
            logs["host"] = run_folder / "host.log"
        if recording is not None:
            logs["recorder"] = log_of(run_folder)
        self._recording_plan = recording
        self._logs = logs
        self._console = Console(logs, lambda: bool(signals), self._as_here)

    def execute(self, options: argparse.Namespace) -> int:
        """Start, supervise, clean up, report."""
        started, started_s = time.time(), time.monotonic()
        guardian = Guardian.start(
            self._run_id, self._domain, guardian_environment(self._session(started))
        )
        guardian.remove_later(self._run_folder / SOCKET_NAME)
        observation = self._observation(options)
        outcome = Outcome(exit_code=1, reason="the launcher failed", ended_s=started_s)
        recording = None
        try:
            self._console.log("INFO", f"{self._domain.reason}; run folder {self._run_folder}")
            for severity, notice in self._plan.back_end.notices:
                self._console.log(severity, notice)
            recording = self._recording(guardian)
            supervisor = self._supervisor(guardian)
            outcome = supervisor.outcome
            shown = Shown(self._run_id, self._run_folder, self._beside(), self._logs)
            self._views.start(shown, guardian, self._console.log)
            supervisor.run()
        except BaseException as error:  # for run.json; the command line knows what to say
            outcome.exit_code = EXIT_ENVIRONMENT if isinstance(error, EnvironmentFault) else 1
            outcome.reason = f"not started: {error}"
            raise
        finally:
            recorded = None if recording is None else recording.finish(self._signals)
            observed, faults = observation.finish()
            for fault in (*outcome.faults, *faults):
                outcome.fail(fault, EXIT_ENVIRONMENT)
            self._views.finish()
            guardian.finish()
            # Whoever has ended the run is not made to wait for a reader that does not read.
            self._console.finish(_PATIENCE_S if outcome.is_signalled else None)
            outcome.reason = self._as_here(outcome.reason)
            wall_s = outcome.ended_s - (outcome.started_s or started_s)
            record = run_record(self._plan.project, self._files, outcome, wall_s, self._run_folder)
            record |= {
                "backend": self._plan.backend,
                **self._plan.back_end.record(),
                "domain_id": self._domain.id,
                "namespace": self._plan.project.names.namespace,
                "started": started,
                **observed,
            }
            if recording is not None and recorded is not None:
                for problem in recording.report(recorded, record):
                    outcome.fail(problem, EXIT_ENVIRONMENT)
            self._judge(record, outcome)
            self._save(record, outcome)
        self._console.write("\n" + run_table(record) + "\n")
        for reason in outcome.failures:
            if reason != outcome.reason:
                self._console.log("ERROR", reason)
        if "recording" in record:
            self._console.log("INFO", summary(record["recording"]))
        is_good = outcome.exit_code in (0, *_ENDED_BY_SIGNAL)
        self._console.log("INFO" if is_good else "ERROR", outcome.reason)
        return outcome.exit_code

    def _recording(self, guardian: Guardian) -> Recording | None:
        if self._recording_plan is None:
            return None
        return Recording(
            self._recording_plan, self._run_id, self._run_folder, self._beside(), guardian
        )

    def _beside(self) -> dict[str, str]:
        """What programs beside the nodes get, which know the same messages."""
        path = {key: os.environ[key] for key in ("PYTHONPATH",) if key in os.environ}
        messages = self._plan.messages
        return with_messages({**path, **self._environment()}, messages.paths if messages else ())

    def _judge(self, record: dict[str, Any], outcome: Outcome) -> None:
        """Hold the run to its budgets."""
        broken = broken_budgets(
            record, self._plan.project.budgets, is_partial=self._plan.is_partial
        )
        for text in broken:
            outcome.fail(f"budget broken: {text}", EXIT_BUDGET)
        record |= {"exit_code": outcome.exit_code, "reason": outcome.reason}
        record["broken_budgets"] = broken

    def _save(self, record: dict[str, Any], outcome: Outcome) -> None:
        """Write ``run.json``; where there is no room for it, among the temporary files."""
        try:
            write_record(record, self._run_folder)
        except OSError as error:
            spare = Path(tempfile.gettempdir(), f"neuros-{self._run_id}")
            problem = f"{self._run_folder / 'run.json'} cannot be written ({error.strerror})"
            outcome.fail(f"{problem}: it is in {spare}, if there is room", EXIT_ENVIRONMENT)
            record |= {"exit_code": outcome.exit_code, "reason": outcome.reason}
            with contextlib.suppress(OSError):
                spare.mkdir()
                write_record(record, spare)

    def _observation(self, options: argparse.Namespace) -> Observation:
        names = [file.node.name for file in self._files]
        is_one_process = self._plan.backend == "in-process"
        return Observation(
            options,
            self._run_id,
            self._run_folder,
            self._plan.project,
            names,
            is_one_process=is_one_process,
        )

    def _as_here(self, text: str) -> str:
        """With the names that paths have on this machine."""
        return self._plan.back_end.as_here(text, self._files[0].folders)

    def _session(self, started: float) -> Session:
        """What `neuros ps` shows of it."""
        return Session(
            self._run_id,
            self._plan.project.name,
            self._plan.backend,
            tuple(file.node.name for file in self._files),
            str(self._run_folder),
            started,
            this_process(),
            self._plan.project.names.namespace,
        )

    def _supervisor(self, guardian: Guardian) -> Supervisor:
        return Supervisor(
            self._files,
            self._plan.launcher(self._domain.id, guardian),
            self._environment(),
            self._run_folder,
            self._console,
            self._signals,
            duration_s=self._plan.duration.wall_s,
            sides=Sides(self._run_id, self._plan.elsewhere, self._files, self._where_to_start()),
            waker=self._waker,
        )

    def _where_to_start(self) -> str:
        """How nodes elsewhere join this run."""
        namespace = self._plan.project.names.namespace
        options = [f"-d {self._domain.id}"]
        options += [f"--namespace {namespace}"] if namespace else []
        options += ["--network"] if self._plan.network.is_wide else []
        return f" (started by -n, with the same nodes and connections, {' and '.join(options)})"

    def _environment(self) -> dict[str, str]:
        """What every node gets, whatever the shell that NeuROS was started from has sourced."""
        return {
            **self._plan.network.environment(os.environ),
            ELSEWHERE_VARIABLE: ",".join(self._plan.elsewhere),
            "NEUROS_RUN_ID": self._run_id,
            "ROS_DOMAIN_ID": str(self._domain.id),
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",  # the only one that the wheels bring
            "ROS_LOG_DIR": str(self._run_folder),
        }


def _dry_run(
    plan: Plan, domain: DomainLock, output: str | None, recording: RecordingPlan | None
) -> int:
    folder = run_folder_path(output, plan.project.name, "<utc time>")
    print(f"back end {plan.backend}; {domain.reason}; run folder {folder}")
    messages = plan.messages.describe() if plan.messages else ()
    for line in (*plan.pythons.notices, *plan.pythons.describe(), *messages):
        print(line)
    for _, notice in plan.back_end.notices:
        print(notice)
    for line in plan.launcher(domain.id).describe(plan.node_files(folders_of(plan, folder))):
        print(line)
    if recording is not None:
        names = ", ".join([*(topic.name for topic in recording.topics), *recording.listen])
        print(f"recorder: {names or 'nothing'} ({recording.storage})")
    return 0


@contextmanager
def _signals_noted() -> Iterator[tuple[list[int], socket.socket]]:
    """Collect SIGINT and SIGTERM instead of dying of them, until the run is cleaned up.

    Yields them, and a socket to which a byte goes for each, and whenever a child has ended.
    """
    noted: list[int] = []
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # else nohup wants it to go on
        numbers.append(signal.SIGHUP)
    previous = {
        number: signal.signal(number, lambda number, _: noted.append(number)) for number in numbers
    }
    previous[signal.SIGCHLD] = signal.signal(signal.SIGCHLD, lambda *_: None)
    waker = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)  # launch.py had them wait
    try:
        yield noted, reader
    finally:
        signal.set_wakeup_fd(waker)
        for number, handler in previous.items():
            signal.signal(number, handler)
        reader.close()
        writer.close()
