"""One run of a plan, from its first process to ``run.json``."""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from neuros.api.observation import Observation, check_observation
from neuros.api.plan import Plan
from neuros.api.run_folder import (
    LAUNCHER_LOG,
    Recording,
    log_of,
    make_run_folder,
    recording_of,
    removed_folders,
    summary,
    write_node_files,
)
from neuros.api.run_record import broken_budgets, losses, run_record, run_table
from neuros.backends.console import (
    LAYOUT,
    LogTail,
    NonBlockingWriter,
    Progress,
    format_record,
    wants_colours,
)
from neuros.backends.control_sockets import SESSION_SOCKET_NAME, UnixListener
from neuros.backends.domain import DomainLock, choose_domain
from neuros.backends.node_command import with_messages
from neuros.backends.reaper import Reaper
from neuros.backends.sessions import Session, reaper_environment, this_process
from neuros.control import CONTROL_VARIABLE, ELSEWHERE_VARIABLE
from neuros.errors import EnvironmentFault, UsageError, printable
from neuros.launcher.outcome import Outcome
from neuros.launcher.peers import Peers
from neuros.launcher.supervisor import Supervisor
from neuros.options import recorded_values
from neuros.ordinary_files import open_log
from neuros.ports import Shown, View
from neuros.recording.recording_plan import RecordingPlan
from neuros.recording.run_file import RUN_FILE, write_run_file

EXIT_ENVIRONMENT, EXIT_BUDGET = 4, 5
_ENDED_BY_SIGNAL = (130, 143)
_PATIENCE_S = 1.0


class Execution:
    """One run of a plan.

    Args:
        stream: where to show what goes on, ``None``: nowhere.
        signals: numbers of the signals that have arrived; signal handlers append to it.
        waker: bytes arrive here whenever a signal does, or a wish.
        wishes: reasons for which this program wants the run to end, drained.
        views: what shows it while it goes on.

    Raises:
        UsageError: if there can be no such run folder, domain or recording.
        EnvironmentFault: if no domain is free, or what it is to be watched with is missing.
    """

    def __init__(
        self,
        plan: Plan,
        stream: TextIO | None,
        signals: list[int],
        waker: socket.socket,
        wishes: Sequence[str] = (),
        views: Sequence[View] = (),
    ) -> None:
        self._plan = plan
        self._signals = signals
        self._waker = waker
        self._wishes = wishes
        self._views = views
        self._run_id = os.urandom(8).hex()
        try:
            self._prepare(stream)
        except BaseException:
            plan.deployment.finish(lambda: True)
            raise

    def _prepare(self, stream: TextIO | None) -> None:
        plan, signals = self._plan, self._signals
        check_observation(monitors_load=plan.request.monitor_system_load)
        self._recording_plan = recording_of(plan, os.environ)
        if plan.request.isolate and plan.back_end.has_own_network:
            _check_reach(self._recording_plan)
        self._domain = run_domain(plan, self._recording_plan)
        try:
            self.folder = make_run_folder(plan.request.output, plan.project.name)
            self._files = write_node_files(plan, self.folder)
        except BaseException:
            self._domain.release()
            raise
        self._listener = plan.deployment.control_listener(self.folder) or UnixListener(self.folder)
        # By what is to be shown of their origin.
        self._logs = {f.node.name: self.folder / f.node.name / "node.log" for f in self._files}
        self._logs |= plan.deployment.logs(self.folder)
        if self._recording_plan is not None:
            self._logs["recorder"] = log_of(self.folder)
        self._console = Console(
            stream,
            self._logs,
            self.folder / LAUNCHER_LOG,
            lambda: bool(signals),
            self._as_here,
            shows_progress=plan.request.progress,
        )

    @property
    def output_failure(self) -> OSError | None:
        """Why a part of what was to be shown was lost."""
        return self._console.failure

    def run(self) -> dict[str, Any]:
        """Start, supervise, clean up, report; returns the content of ``run.json``.

        Raises:
            EnvironmentFault: if it could not be started.
        """
        started = time.time()
        with contextlib.ExitStack() as stack:
            stack.callback(self._domain.release)
            environment = reaper_environment(self._session(started))
            reaper = Reaper.start(self._run_id, self._domain, environment)
            stack.callback(reaper.finish)
            for file in self._listener.files:
                reaper.remove_later(file)
            if self._plan.is_held:
                reaper.remove_later(self.folder / SESSION_SOCKET_NAME)
            return self._run(reaper, started)

    @property
    def control_address(self) -> str:
        """Where observers connect to its control channel."""
        return self._listener.address

    def cancel(self) -> None:
        """Give up what it holds, in the place of :meth:`run`."""
        self._plan.deployment.finish(lambda: True)
        self._domain.release()

    def _run(self, reaper: Reaper, started: float) -> dict[str, Any]:
        started_s = time.monotonic()
        observation = Observation(self._plan, self._run_id, self.folder)
        outcome = Outcome(exit_code=1, reason="the launcher failed", ended_s=started_s)
        recording = None
        try:
            self._console.log("INFO", f"{self._domain.reason}; run folder {self.folder}")
            self._console.log("INFO", self._how_to_look())
            for severity, notice in self._plan.notices:
                self._console.log(severity, notice)
            if self._recording_plan is not None:
                recording = Recording(
                    self._recording_plan, self._run_id, self.folder, self._beside(), reaper
                )
            supervisor = self._supervisor(reaper)
            outcome = supervisor.outcome
            duration = self._plan.request.end
            self._console.follow(Progress(outcome, duration.wall_s, duration.sim_s))
            for view in self._views:
                view.start(self._shown(), reaper, self._console.log)
            supervisor.run()
        except BaseException as error:  # for run.json; the command line knows what to say
            outcome.exit_code = EXIT_ENVIRONMENT if isinstance(error, EnvironmentFault) else 1
            outcome.reason = f"not started: {error}"
            raise
        finally:
            before = len(self._signals)
            left_behind = self._plan.deployment.finish(lambda: len(self._signals) > before)
            recorded = None if recording is None else recording.finish(self._signals)
            observed, faults = observation.finish()
            removed = removed_folders(self._files, self.folder)
            for fault in (*removed, *outcome.faults, *left_behind, *faults):
                outcome.fail(fault, EXIT_ENVIRONMENT)
            for view in self._views:
                view.finish()
            if not reaper.is_on_duty:
                self._console.log("WARN", "the reaper was killed: the launcher does its work")
            reaper.leave()  # it works while the record is made
            # A user who has ended the run does not wait for a reader that does not read.
            self._console.finish(_PATIENCE_S if outcome.is_signalled else None)
            outcome.reason = self._as_here(outcome.reason)
            outcome.failures = [self._as_here(text) for text in outcome.failures]
            outcome.stacks = {name: self._as_here(s) for name, s in outcome.stacks.items()}
            wall_s = outcome.ended_s - (outcome.started_s or started_s)
            record = run_record(self._plan.project, self._files, outcome, wall_s, self.folder)
            record |= {
                "backend": self._plan.back_end.name,
                "is_one_process": self._plan.back_end.is_one_process,
                **self._plan.deployment.record(),
                "domain_id": self._domain.id,
                "namespace": self._plan.project.names.namespace,
                "started": started,
                "options": recorded_values(self._plan.request),
                **observed,
            }
            _add_load_elsewhere(record)
            reaper.finish()
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
        return record

    def _how_to_look(self) -> str:
        """The commands that show the topics of the run, to be copied."""
        own = f"to look into it: neuros topic list {self._run_id[:8]}"
        if self._plan.request.isolate:
            return own
        return f"{own}, or ROS_DOMAIN_ID={self._domain.id} ros2 topic list"

    def _shown(self) -> Shown:
        plan = self._plan
        return Shown(
            self._run_id,
            self.folder,
            self._beside(),
            self._logs,
            plan.project,
            plan.names,
            plan.back_end.is_one_process,
        )

    def _beside(self) -> dict[str, str]:
        """What programs beside the nodes get, which know the same messages."""
        path = {key: os.environ[key] for key in ("PYTHONPATH",) if key in os.environ}
        path[CONTROL_VARIABLE] = self._listener.address
        messages = self._plan.messages
        return with_messages({**path, **self._environment()}, messages.paths if messages else ())

    def _judge(self, record: dict[str, Any], outcome: Outcome) -> None:
        """Hold the run to what lossless connections promise, and to its budgets."""
        if outcome.exit_code in (0, EXIT_ENVIRONMENT):  # else it was not drained
            lost = losses(record)
            for text in lost:
                outcome.fail(text)
            if outcome.late_drain and not lost:
                self._console.log(
                    "INFO", "not drained in time, but no packet of a lossless connection was lost"
                )
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
            write_run_file(record, self.folder)
        except OSError as error:
            spare = Path(tempfile.gettempdir(), f"neuros-{self._run_id}")
            problem = f"{self.folder / RUN_FILE} cannot be written ({error.strerror})"
            outcome.fail(f"{problem}: it is in {spare} instead, if there is room", EXIT_ENVIRONMENT)
            record |= {"exit_code": outcome.exit_code, "reason": outcome.reason}
            with contextlib.suppress(OSError):
                spare.mkdir(0o700)
                write_run_file(record, spare)

    def _as_here(self, text: str) -> str:
        """With the names that paths have on this machine."""
        return self._plan.deployment.as_here(text, self._files[0].folders)

    def _session(self, started: float) -> Session:
        """What `neuros ps` shows of it."""
        return Session(
            self._run_id,
            self._plan.project.name,
            self._plan.back_end.name,
            tuple(file.node.name for file in self._files),
            str(self.folder),
            started,
            this_process(),
            self._plan.project.names.namespace,
            self._plan.back_end.is_one_process,
            self._listener.address,
            elsewhere=self._plan.places,
        )

    def _supervisor(self, reaper: Reaper) -> Supervisor:
        return Supervisor(
            self._files,
            self._plan.launcher(reaper),
            self._environment(),
            self.folder,
            self._console,
            self._signals,
            listener=self._listener,
            wishes=self._wishes,
            duration_s=self._plan.request.end.wall_s,
            finalise_s=self._plan.request.finalise_s,
            peers=Peers(
                self._run_id,
                self._plan.elsewhere,
                self._files,
                self._where_to_start(),
                self._plan.request.peer_timeout,
            ),
            waker=self._waker,
            is_held=self._plan.is_held,
            on_stop=_import_for_record,
        )

    def _where_to_start(self) -> str:
        """How nodes elsewhere join this run."""
        namespace = self._plan.project.names.namespace
        options = [f"-d {self._domain.id}"]
        options += [f"--namespace {namespace}"] if namespace else []
        options += ["--network"] if self._plan.network.is_wide else []
        return f" (started by -n, with the same nodes and connections, {' and '.join(options)})"

    def _environment(self) -> dict[str, str]:
        """The environment of every node; it overrides what the shell has sourced."""
        is_in_notebook = os.environ.get("MPLBACKEND", "").startswith("module://")
        return {
            **self._plan.network.environment(os.environ),
            ELSEWHERE_VARIABLE: ",".join(self._plan.elsewhere),
            # What a notebook has Matplotlib draw with is in the notebook, and in no node.
            **({"MPLBACKEND": ""} if is_in_notebook else {}),
            "NEUROS_RUN_ID": self._run_id,
            "ROS_DOMAIN_ID": str(self._domain.id),
            "ROS_LOG_DIR": str(self.folder),
        }


def _import_for_record() -> None:
    """Import what makes the record while nodes end: that takes a tenth of a processor second."""

    def load() -> None:
        for name in ("neuros.api.packets", "tabulate"):
            importlib.import_module(name)

    with contextlib.suppress(RuntimeError):  # no more threads: then it is imported when needed
        threading.Thread(target=load, name="neuros-record", daemon=True).start()


def _add_load_elsewhere(record: dict[str, Any]) -> None:
    """The nodes of other machines, in percent of a core there."""
    own = record.get("system_load")
    for machine in record.get("machines", {}).values():
        load = machine["system_load"]
        if own and load:
            own["processes"] |= {name: load["processes"].get(name) for name in machine["nodes"]}


def _check_reach(recording: RecordingPlan | None) -> None:
    """The recorder is not in the network of isolated containers."""
    if recording and recording.listen:
        raise UsageError(
            f"--isolate: the recorder cannot hear {', '.join(recording.listen)} in the network of"
            " the containers: --exclude these topics, or use --backend process"
        )


def run_domain(plan: Plan, recording: RecordingPlan | None) -> DomainLock:
    """The ROS domain of a run; released by closing it.

    Raises:
        UsageError: if the one that is asked for is none.
        EnvironmentFault: if none is free.
    """
    is_known = plan.needs_known_domain or bool(recording and recording.wanted)
    return choose_domain(plan.request.domain_id, os.environ, is_known)


# ---------------------------------------------------------------------- console
#
# Console output of a run: the launcher's records, the log lines of nodes, and the progress.


_REDRAW_S = 0.5
_PLAIN_S = 10.0
CLEAR = "\r\x1b[K"


class ProgressLine:
    """Shows the progress of a run.

    Args:
        stream: a terminal gets a line that stays below all others.
        is_wanted: ``None``: if it is known when the run ends.
        log: writes a plain record.
    """

    def __init__(
        self, stream: TextIO | None, is_wanted: bool | None, log: Callable[[str], None]
    ) -> None:
        self._is_wanted = is_wanted
        self._log = log
        is_terminal = stream is not None and stream.isatty()
        self._is_line = is_terminal and os.environ.get("TERM") != "dumb"
        self._is_ascii = "utf" not in str(getattr(stream, "encoding", "")).lower()
        self._progress: Progress | None = None
        self._next_s = 0.0
        self._shown = ""

    def follow(self, progress: Progress) -> None:
        """Show this from now on."""
        self._progress = progress
        self._next_s = time.monotonic() + (0.0 if self._is_line else _PLAIN_S)

    def around(self, text: str) -> str:
        """Text as it is to be written while there is a line: above it."""
        return f"{CLEAR}{text}{self._shown}" if self._shown else text

    def update(self) -> str:
        """What is to be written now to draw the line again; plain lines are logged."""
        progress = self._progress
        if progress is None or self._is_wanted is False or time.monotonic() < self._next_s:
            return ""
        if not (self._is_wanted or progress.has_end):
            return ""
        self._next_s = time.monotonic() + (_REDRAW_S if self._is_line else _PLAIN_S)
        if not self._is_line:
            if text := progress.text():
                self._log(text)
            return ""
        columns = shutil.get_terminal_size().columns
        self._shown = progress.bar(columns, is_ascii=self._is_ascii)
        return f"{CLEAR}{self._shown}" if self._shown else ""

    def end(self) -> str:
        """What is to be written to take the line away; nothing is shown any more."""
        self._progress = None
        was_shown, self._shown = bool(self._shown), ""
        return CLEAR if was_shown else ""


class Console:
    """Where a run is shown; nothing here waits for a reader but :meth:`finish`.

    Args:
        stream: where to write, ``None``: nowhere.
        logs: the log files to show, by name.
        log_file: that of the launcher, for what is too long to be shown.
        is_enough: whether the user wants no more of it (asked while it waits).
        translate: from what nodes say to what the user knows (names of paths).
        shows_progress: whether to show how far the run has come; ``None``: if its end is known.
    """

    def __init__(
        self,
        stream: TextIO | None,
        logs: Mapping[str, Path],
        log_file: Path,
        is_enough: Callable[[], bool],
        translate: Callable[[str], str] = str,
        *,
        shows_progress: bool | None = None,
    ) -> None:
        self._writer = NonBlockingWriter(stream)
        self._log_file = log_file
        self._translate = translate
        self._layout = os.environ.get("RCUTILS_CONSOLE_OUTPUT_FORMAT", LAYOUT)
        colours = stream is not None and wants_colours(stream, os.environ)
        self._tail = LogTail({} if stream is None else logs, self._show, colours)
        self._line = ProgressLine(stream, shows_progress, lambda text: self.log("INFO", text))
        self._is_enough = is_enough
        self._is_finishing = False
        self._patience_s: float | None = None

    @property
    def failure(self) -> OSError | None:
        """Why text was lost, if not because its reader has gone."""
        return self._writer.failure

    def write(self, text: str) -> None:
        """Write what does nothing to a terminal, with the names of paths that the user knows."""
        self._show(printable(text))

    def _show(self, text: str) -> None:
        self._writer.write(self._line.around(self._translate(text)))
        if self._is_finishing:
            self._writer.finish(self._is_enough, self._patience_s)

    def log(self, severity: str, text: str) -> None:
        """Write a record of the launcher itself, after what nodes have logged so far.

        One of severity ``DEBUG`` goes to the log of the launcher only.
        """
        if severity == "DEBUG":
            self._keep(format_record(severity, "neuros", text))
            return
        self.poll()
        self.write(format_record(severity, "neuros", text, layout=self._layout) + "\n")

    def _keep(self, record: str) -> None:
        with contextlib.suppress(OSError), open_log(self._log_file) as log:
            log.write(f"{record}\n".encode(errors="backslashreplace"))

    def follow(self, progress: Progress) -> None:
        """Show how far the run has come."""
        self._line.follow(progress)

    def poll(self) -> object:
        """Show what nodes have logged since; it stays in their files while the reader is behind."""
        self._writer.flush()
        if self._writer.is_behind or self._is_finishing:
            return None
        self._writer.write(self._line.update())
        return self._tail.poll()

    def finish(self, patience_s: float | None) -> None:
        """Show the rest; from now on wait for the reader, or lose ``patience_s`` seconds."""
        self._writer.write(self._line.end())
        self._is_finishing = True
        self._patience_s = patience_s
        self.write("")
        self._tail.drain()
