"""One run of a plan, from its first process to ``run.json``."""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from neuros.api.observation import Observation
from neuros.api.plan import Plan
from neuros.api.run_folder import (
    LAUNCHER_LOG,
    Recording,
    log_of,
    make_run_folder,
    recording_of,
    removed_folders,
    save_record,
    summary,
    write_node_files,
)
from neuros.api.run_record import EXIT_ENVIRONMENT, judge, run_record, run_table
from neuros.backends.console import (
    LAYOUT,
    LogTail,
    NonBlockingWriter,
    Progress,
    format_record,
    wants_colours,
)
from neuros.backends.control_sockets import UnixListener
from neuros.backends.domain import DomainLock, choose_domain
from neuros.backends.guardian import Guardian, start_guardian
from neuros.backends.node_command import with_messages
from neuros.backends.portable import common_variables
from neuros.backends.process_launchers import WITHOUT_ROS
from neuros.backends.sessions import RunOnThisMachine, mark, this_process
from neuros.backends.sidecars import Recorded
from neuros.control import CONTROL_VARIABLE, ELSEWHERE_VARIABLE
from neuros.errors import EnvironmentFault, UsageError, printable
from neuros.launcher.outcome import Outcome
from neuros.launcher.peers import Peers
from neuros.launcher.supervisor import Supervisor
from neuros.options import recorded_values
from neuros.ports import Shown, View
from neuros.recording.recording_plan import RecordingPlan

_ENDED_BY_SIGNAL = (130, 143)
_PATIENCE_S = 1.0


class Execution:
    """One run of a plan.

    Args:
        stream: where the run is shown, ``None``: nowhere.
        signals: numbers of the signals that have arrived; signal handlers append to it.
        waker: bytes arrive here with each signal and each wish.
        wishes: reason and exit code of each end that this program asks for.
        views: viewers that show the run while it goes on.
        guardian: the one of the run, if it has been started.

    Raises:
        UsageError: if the run folder, the domain or the recording is impossible.
        EnvironmentFault: if no domain is free.
    """

    def __init__(
        self,
        plan: Plan,
        stream: TextIO | None,
        signals: list[int],
        waker: socket.socket,
        wishes: list[tuple[str, int]] | None = None,
        views: Sequence[View] = (),
        guardian: Guardian | None = None,
    ) -> None:
        self._plan = plan
        self._signals = signals
        self._waker = waker
        self._wishes = wishes
        self._views = views
        self._guardian = guardian or start_guardian(plan.back_end)
        self._run_id = self._guardian.run_id
        with contextlib.ExitStack() as stack:
            stack.callback(self._guardian.finish)
            stack.callback(plan.deployment.finish, lambda: True)
            self._recording_plan = recording_of(plan, os.environ)
            listened = self._recording_plan.listen if self._recording_plan else ()
            if plan.request.isolate and plan.back_end.has_own_network and listened:
                raise UsageError(
                    f"--isolate: the recorder cannot hear {', '.join(listened)} in the network of"
                    " the containers: --exclude these topics, or use --backend process"
                )
            self._domain = run_domain(plan, self._recording_plan)
            stack.callback(self._domain.release)
            self.folder = make_run_folder(plan.request.output, plan.project.name)
            self._plan, self._files = write_node_files(plan, self.folder)
            self._listener = plan.deployment.control_listener(self.folder) or UnixListener(
                self.folder
            )
            # The key is the name that the console shows in front of the lines of a log.
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
            stack.pop_all()  # all is there: run() releases it, or cancel()

    @property
    def output_failure(self) -> OSError | None:
        """Why a part of the output was lost."""
        return self._console.failure

    @property
    def control_address(self) -> str:
        """Where observers connect to the control channel."""
        return self._listener.address

    def cancel(self) -> None:
        """Release what the run holds, in place of :meth:`run`."""
        self._plan.deployment.finish(lambda: True)
        self._domain.release()
        self._guardian.finish()

    def run(self) -> dict[str, Any]:
        """Start, supervise, clean up, report; returns the content of ``run.json``.

        Raises:
            EnvironmentFault: if the run could not be started.
        """
        started = time.time()
        with contextlib.ExitStack() as stack:
            stack.callback(self._domain.release)
            guardian = self._guardian
            stack.callback(guardian.finish)
            guardian.await_ready()
            if self._plan.back_end.is_forked:
                messages = self._plan.messages
                ports = [port for f in self._files for port in (*f.node.inputs, *f.node.outputs)]
                types = sorted({port.ros_type for port in ports})
                guardian.import_early(
                    ["neuros.cli.node", "load_messages", *types],
                    folders=messages.paths if messages else (),
                )
            its_mark = mark(self._session(started))
            stack.callback(its_mark.release)
            for lock in (self._domain, its_mark):
                guardian.hold(lock)
            for file in self._listener.files:
                guardian.remove_later(file)
            return self._run(guardian, started)

    def _run(self, guardian: Guardian, started: float) -> dict[str, Any]:
        started_s = time.monotonic()
        observation = Observation(self._plan, self._run_id, self.folder)
        outcome = Outcome(exit_code=1, reason="the launcher failed", ended_s=started_s)
        recording = None
        try:
            self._console.log("INFO", f"{self._domain.reason}; run folder {self.folder}")
            commands = f"neuros topic list {self._run_id[:8]}"
            is_hidden = self._plan.deployment.transport == WITHOUT_ROS
            if not (self._plan.request.isolate or is_hidden):
                commands += f", or ROS_DOMAIN_ID={self._domain.id} ros2 topic list"
            self._console.log("INFO", f"to look into it: {commands}")
            for severity, notice in self._plan.notices:
                self._console.log(severity, notice)
            if self._recording_plan is not None:
                recording = Recording(
                    self._recording_plan, self._run_id, self.folder, self._beside()
                )
            supervisor = self._supervisor(guardian)
            outcome = supervisor.outcome
            duration = self._plan.request.end
            self._console.follow(Progress(outcome, duration.wall_s, duration.sim_s))
            for view in self._views:
                view.start(self._shown(), guardian, self._console.tell)
            supervisor.run()
        except BaseException as error:  # for run.json; the command line shows the error
            outcome.exit_code = EXIT_ENVIRONMENT if isinstance(error, EnvironmentFault) else 1
            outcome.reason = f"not started: {error}"
            raise
        finally:
            recorded, observed = self._stop(outcome, recording, observation)
            if not guardian.is_on_duty:
                self._console.log("WARN", "the guardian was killed: the launcher does its work")
            guardian.leave()  # it works while the record is made
            # A user who has ended the run does not wait for a reader that does not read.
            self._console.finish(_PATIENCE_S if outcome.is_signalled else None)
            record = self._record(outcome, observed, started, started_s)
            guardian.finish()
            if recording is not None and recorded is not None:
                for problem in recording.report(recorded, record):
                    outcome.fail(problem, EXIT_ENVIRONMENT)
            was_drained = outcome.exit_code in (0, EXIT_ENVIRONMENT)
            budgets, is_partial = self._plan.project.budgets, self._plan.is_partial
            lost = judge(record, outcome, budgets, is_partial=is_partial)
            if was_drained and outcome.late_drain and not lost:
                text = "not drained in time, but no packet of a lossless connection was lost"
                self._console.log("INFO", text)
            save_record(record, outcome, self.folder, self._run_id)
        self._console.write("\n" + run_table(record) + "\n")
        for reason in outcome.failures:
            if reason != outcome.reason:
                self._console.log("ERROR", reason)
        if "recording" in record:
            self._console.log("INFO", summary(record["recording"]))
        is_good = outcome.exit_code in (0, *_ENDED_BY_SIGNAL)
        self._console.log("INFO" if is_good else "ERROR", outcome.reason)
        return record

    def _stop(
        self, outcome: Outcome, recording: Recording | None, observation: Observation
    ) -> tuple[Recorded | None, dict[str, Any]]:
        """Stop all that ran beside the nodes; returns what was recorded and observed."""
        before = len(self._signals)
        left_behind = self._plan.deployment.finish(lambda: len(self._signals) > before)
        recorded = None if recording is None else recording.finish(self._signals)
        observed, faults = observation.finish()
        removed = removed_folders(self._files, self.folder)
        for fault in (*removed, *outcome.faults, *left_behind, *faults):
            outcome.fail(fault, EXIT_ENVIRONMENT)
        for view in self._views:
            view.finish()
        return recorded, observed

    def _record(
        self, outcome: Outcome, observed: dict[str, Any], started: float, started_s: float
    ) -> dict[str, Any]:
        """The content of ``run.json``, but for recording, exit code and budgets."""
        outcome.reason = self._as_here(outcome.reason)
        outcome.failures = [self._as_here(text) for text in outcome.failures]
        outcome.stacks = {name: self._as_here(s) for name, s in outcome.stacks.items()}
        wall_s = outcome.ended_s - (outcome.started_s or started_s)
        record = run_record(self._plan.project, self._files, outcome, wall_s, self.folder)
        record |= {
            "backend": self._plan.back_end.name,
            "is_one_process": self._plan.back_end.is_one_process,
            "is_portable": self._plan.project.is_portable,
            **self._plan.deployment.record(),
            "domain_id": self._domain.id,
            "namespace": self._plan.project.names.namespace,
            "started": started,
            "options": recorded_values(self._plan.request),
            **self._plan.provenance,
            **observed,
        }
        # Nodes of other machines are in percent of a core there.
        own = record.get("system_load")
        for machine in record.get("machines", {}).values():
            load = machine["system_load"]
            if own and load:
                own["processes"] |= {n: load["processes"].get(n) for n in machine["nodes"]}
        return record

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
        """The environment of programs beside the nodes, which know the same messages."""
        path = {key: os.environ[key] for key in ("PYTHONPATH",) if key in os.environ}
        path[CONTROL_VARIABLE] = self._listener.address
        messages = self._plan.messages
        return with_messages({**path, **self._environment()}, messages.paths if messages else ())

    def _as_here(self, text: str) -> str:
        """A text of a node with the paths of this machine in it."""
        return self._plan.deployment.as_here(text, self._files[0].folders)

    def _session(self, started: float) -> RunOnThisMachine:
        """The entry of `neuros ps` for this run."""
        return RunOnThisMachine(
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

    def _supervisor(self, guardian: Guardian) -> Supervisor:
        namespace = self._plan.project.names.namespace
        options = [f"-d {self._domain.id}"]
        options += [f"--namespace {namespace}"] if namespace else []
        options += ["--network"] if self._plan.network.is_wide else []
        how = f" (started by -n, with the same nodes and connections, {' and '.join(options)})"
        return Supervisor(
            self._files,
            self._plan.launcher(guardian),
            self._environment(),
            self.folder,
            self._console,
            self._signals,
            listener=self._listener,
            wishes=self._wishes,
            duration_s=None if self._plan.project.is_virtual else self._plan.request.end.wall_s,
            finalise_s=self._plan.request.finalise_s,
            peers=Peers(
                self._run_id,
                self._plan.elsewhere,
                self._files,
                how,
                self._plan.request.peer_timeout,
            ),
            waker=self._waker,
            is_held=self._plan.is_held,
            on_stop=_import_for_record,
        )

    def _environment(self) -> dict[str, str]:
        """Variables of every node; they override those of the shell."""
        plan = self._plan
        is_portable = plan.project.is_portable and plan.back_end.is_one_process
        is_in_notebook = os.environ.get("MPLBACKEND", "").startswith("module://")
        return {
            **plan.network.environment(os.environ),
            **(common_variables(plan.nodes, os.environ) if is_portable else {}),
            ELSEWHERE_VARIABLE: ",".join(plan.elsewhere),
            # The back end that a notebook sets for Matplotlib exists in the notebook only.
            **({"MPLBACKEND": ""} if is_in_notebook else {}),
            "NEUROS_RUN_ID": self._run_id,
            "ROS_DOMAIN_ID": str(self._domain.id),
            "ROS_LOG_DIR": str(self.folder),
        }


def _import_for_record() -> None:
    """Import in the background what makes the record: 0.1 s, spent while nodes end."""

    def load() -> None:
        for name in ("neuros.api.packets", "tabulate"):
            importlib.import_module(name)

    with contextlib.suppress(RuntimeError):  # no thread can be started: imported when needed
        threading.Thread(target=load, name="neuros-record", daemon=True).start()


def run_domain(plan: Plan, recording: RecordingPlan | None) -> DomainLock:
    """The ROS domain of a run, locked.

    Raises:
        UsageError: if ``--domain-id`` is no domain.
        EnvironmentFault: if no domain is free.
    """
    is_known = plan.needs_known_domain or bool(recording and recording.wanted)
    return choose_domain(plan.request.domain_id, os.environ, is_known)


_REDRAW_S = 0.5
_PLAIN_S = 10.0
_CLEAR = "\r\x1b[K"


class Console:
    """Shows a run: records of the launcher, log lines of nodes, and the progress.

    A terminal has the progress on its last line, below all others; elsewhere it is a record every
    10 s. Only :meth:`finish` waits for a reader.

    Args:
        stream: where to write, ``None``: nowhere.
        logs: the log files to show, by name.
        log_file: of the launcher, for records that are too long to be shown.
        is_enough: whether the user has asked for the end; asked while the console waits.
        translate: from texts of nodes to texts with the paths of this machine.
        shows_progress: ``None``: if the run has a known end.
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
        self._is_enough = is_enough
        self._is_finishing = False
        self._patience_s: float | None = None
        is_terminal = stream is not None and stream.isatty()
        self._has_line = is_terminal and os.environ.get("TERM") != "dumb"
        self._is_ascii = "utf" not in str(getattr(stream, "encoding", "")).lower()
        self._shows_progress = shows_progress
        self._progress: Progress | None = None
        self._progress_due_s = 0.0
        self._line = ""

    @property
    def failure(self) -> OSError | None:
        """Why text was lost, if its reader is still there."""
        return self._writer.failure

    def write(self, text: str) -> None:
        """Write text without its control characters, with the paths of this machine."""
        self._show(printable(text))

    def _show(self, text: str) -> None:
        text = self._translate(text)
        self._writer.write(f"{_CLEAR}{text}{self._line}" if self._line else text)
        if self._is_finishing:
            self._writer.finish(self._is_enough, self._patience_s)

    def log(self, severity: str, text: str) -> None:
        """Write a record of the launcher, after what nodes have logged so far, and to its log.

        A record of severity ``DEBUG`` goes to the log only.
        """
        record = format_record(severity, "neuros", text)
        with contextlib.suppress(OSError), open(self._log_file, "ab") as log:
            log.write(f"{record}\n".encode(errors="backslashreplace"))
        if severity != "DEBUG":
            self.poll()
            self.tell(severity, text)

    def tell(self, severity: str, text: str) -> None:
        """Write a record to the console only: addresses with tokens are kept nowhere."""
        self.write(format_record(severity, "neuros", text, layout=self._layout) + "\n")

    def follow(self, progress: Progress) -> None:
        """Show the progress of a run from now on."""
        if self._shows_progress is not False:
            self._progress = progress
            self._progress_due_s = time.monotonic() + (0.0 if self._has_line else _PLAIN_S)

    def poll(self) -> object:
        """Show new log lines and the progress; while the reader is behind, lines stay in files."""
        self._writer.flush()
        if self._writer.is_behind or self._is_finishing:
            return None
        progress, now_s = self._progress, time.monotonic()
        # A node may tell the end of the run while it runs.
        if (
            progress
            and (self._shows_progress or progress.has_end)
            and now_s >= self._progress_due_s
        ):
            self._progress_due_s = now_s + (_REDRAW_S if self._has_line else _PLAIN_S)
            if self._has_line:
                columns = shutil.get_terminal_size().columns
                self._line = progress.bar(columns, is_ascii=self._is_ascii)
                self._writer.write(f"{_CLEAR}{self._line}" if self._line else "")
            elif text := progress.text():
                self.tell("INFO", text)
        return self._tail.poll()

    def finish(self, patience_s: float | None) -> None:
        """Show the rest; from now on wait for the reader, for ``patience_s`` seconds at most."""
        self._writer.write(_CLEAR if self._line else "")
        self._progress, self._line = None, ""
        self._is_finishing = True
        self._patience_s = patience_s
        self.write("")
        self._tail.drain()
