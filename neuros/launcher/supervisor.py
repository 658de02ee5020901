"""Supervises a run: starts its nodes, watches them, and brings it to its end.

The supervisor takes no part in the data path. It hears of the nodes over the control channel, of
their processes from the back end, and of the user by signals; all in one thread, which never waits
for a node or for a reader of its output.
"""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import neuros.control as control
from neuros.control import Message, Report
from neuros.control.link import ControlLink
from neuros.errors import ControlError
from neuros.launcher.channels import Channels, Observers, Overheard, PauseState, Settling
from neuros.launcher.finalising import Finalising
from neuros.launcher.outcome import (
    Outcome,
    Phase,
    Processes,
    SupervisorOutput,
    nodes_of,
)
from neuros.launcher.peers import Peers
from neuros.launcher.quiescence import Declarations, Probing, Verdict, connections_among
from neuros.launcher.shutdown import DRAIN_S, Shutdown
from neuros.launcher.stall_detector import Backlog, StallDetector
from neuros.launcher.start import Start
from neuros.launcher.thread_reader import ThreadReader
from neuros.ports import ControlListener, Launcher, RunningNode
from neuros.project.model import NodeFile

# How often there is a look at clocks and logs: everything else wakes the supervisor by itself.
_TICK_S = 0.02
_QUIET_TICK_S = 0.2
_MOST_REFUSED = 10
_PARTED_S = 1.0
"""A process that has hung up ends within this time, or something has closed its descriptors."""
_KEPT_STILL_S = 1.0
"""Between two looks at the time there is a fifth of that, unless this process may not run."""


class Supervisor:
    """Runs one project on one back end.

    Args:
        files: the nodes to start; ``connections`` among them.
        launcher: the back end.
        environment: added to the environment of every node.
        run_folder: with a folder for each node.
        output: for log records; its ``poll`` shows what nodes have logged.
        signals: numbers of the signals that have arrived, appended to by a signal handler.
        listener: where nodes and observers connect to the control channel.
        wishes: with a reason and an exit code, this program wants the run to end: drained if the
            code is 0, else as failed; appended to by any thread.
        duration_s: wall time from time 0 to a drained end, ``None``: no limit.
        finalise_s: how long nodes may finalise without progress, ``None``: as their files say.
        peers: who starts the other nodes of the project, where not all are started here.
        is_held: whether the nodes start paused, for a session.
        on_stop: called once nodes have been told to end; it must not take long.
        waker: bytes arrive here whenever a signal does, SIGCHLD too; without it signals, and
            processes that end before they have connected, are seen a fifth of a second late.

    Attributes:
        pause: lets the run stand still.
        observers: who watches it.

    Raises:
        EnvironmentFault: if there can be no control channel.
    """

    def __init__(
        self,
        files: Sequence[NodeFile],
        launcher: Launcher,
        environment: Mapping[str, str],
        run_folder: Path,
        output: SupervisorOutput,
        signals: list[int],
        *,
        listener: ControlListener,
        wishes: list[tuple[str, int]] | None = None,
        duration_s: float | None = None,
        finalise_s: float | None = None,
        peers: Peers | None = None,
        waker: socket.socket | None = None,
        is_held: bool = False,
        on_stop: Callable[[], object] = lambda: None,
    ) -> None:
        self._files = files
        self._launcher = launcher
        self._environment = {**environment, control.CONTROL_VARIABLE: listener.address}
        self._output = output = Overheard(output, lambda message: self.observers.tell(message))
        self._wishes = [] if wishes is None else wishes
        self._duration_s = duration_s
        self._paused_before_s = 0.0  # time 0 of the run
        self._peers = peers or Peers("", (), files)
        names = [file.node.name for file in files]
        self._channels = Channels(listener)
        if waker is not None:
            self._channels.wake_on(waker)
        self.outcome = Outcome()
        self._reader = ThreadReader(lambda name: self._processes.with_node(name))
        self._detector = StallDetector(names, time.monotonic(), self._reader)
        self._processes = Processes(self._detector, self.outcome)
        self._peers.speak_through(lambda text: self._channels.send(control.Say(text)))
        connections = connections_among(files)
        self._backlog = Backlog(connections, self._detector.is_held_up)
        peers_to_ask = self._peers if self._peers.exist else None
        self._probing = Probing(names, connections, self._channels.send, peers_to_ask)
        self._declarations = Declarations(files)
        self._start = Start(names, self._peers)
        limits_s = {file.node.name: finalise_s or file.node.finalise_s for file in files}
        self._finalising = Finalising(limits_s, run_folder)
        self._shutdown = Shutdown(
            self._channels,
            self._processes,
            self._detector,
            self._reader,
            self._declarations,
            self._start,
            self._finalising,
            self._probing,
            self._peers,
            self.outcome,
            output,
            signals,
            on_stop,
            not self._peers.exist and _hears_what_nobody_counts(files),
        )
        self.pause = PauseState(self._channels.send, time.monotonic)
        if is_held:
            self.pause.begin()
        self._settling = Settling(names, self._channels)
        self.observers = Observers(
            self._channels,
            self.pause,
            lambda: self._detector.is_driven,
            lambda reason: self._shutdown.drain(reason, DRAIN_S),
            {
                (file.node.name, port.name)
                for file in files
                for port in file.node.inputs
                if is_held and port.external_topic is not None
            },
        )
        self._signals = signals
        self._refused: set[ControlLink] = set()
        self._refused_count = 0
        self._looked_s = time.monotonic()

    def run(self) -> Outcome:
        """Start everything and stay until all of it has ended. Raises ``EnvironmentFault``."""
        try:
            self._shutdown.heed_signals()  # one may have come before anything was started
            if self._shutdown.phase is Phase.RUNNING:
                self._processes.add(self._launcher.start(self._files, self._environment))
            has_shown = True
            self._looked_s = time.monotonic()
            while self._processes and not self._shutdown.is_hopeless:
                self._channels.wait(min(self._pause_s(has_shown), self._settling.wait_s))
                self._shutdown.heed_signals()
                self._heed_program()
                self._hear()
                self._look_at_processes()
                self._look_at_time()
                self._settling.look()
                self._channels.flush()
                has_shown = bool(self._output.poll())
        finally:
            self._shutdown.give_up()
            self._reader.close()
            self._hear()
            self.observers.part(self.outcome)
            self._channels.close()
            self.outcome.elsewhere = self._peers.counters()
            self.outcome.ended_s = time.monotonic()
        return self.outcome

    # ------------------------------------------------------------------ what arrives

    def _heed_program(self) -> None:
        """End as the program that has started the run wishes."""
        while self._wishes:
            reason, exit_code = self._wishes.pop(0)
            if not exit_code:
                self._shutdown.drain(reason, DRAIN_S)
            elif self._shutdown.phase in (Phase.RUNNING, Phase.DRAINING):
                self._shutdown.fail(reason, exit_code)

    def _hear(self) -> None:
        for link, message in self._channels.receive():
            if isinstance(message, ControlError):
                self._refuse(link, message)
            else:
                try:
                    self._take(link, message)
                except ControlError as error:
                    self._refuse(link, error)

    def _refuse(self, link: ControlLink, error: ControlError) -> None:
        """A message is wrong: without it, nothing is known of a node for sure."""
        if self._channels.nodes_of(link):
            if link not in self._refused:
                self._refused.add(link)
                self._shutdown.fail(f"control channel: {error}")
        elif self._channels.has(link):
            self._channels.hang_up(link)
            self._refused_count += 1
            if self._refused_count <= _MOST_REFUSED:
                text = f"control channel: a connection was closed: {error}"
                is_last = self._refused_count == _MOST_REFUSED
                self._output.log("WARN", text + "; further ones are not shown" * is_last)

    def _take(self, link: ControlLink, message: Message) -> None:
        match message:
            case Report():
                self._on_report(message)
            case control.Hello():
                self._on_hello(link, message)
            case control.Loaded():
                self._start.note_loaded(self._channels.nodes_of(link))
            case control.Ready(node):
                self._start.note_ready(node)
                self._detector.note_ready(node)
            case control.Hooks():
                self._declarations.take(message)
                self._finalising.declare(message.node, message.finalise)
                self._detector.note_loaded(message.node)
            case control.Finalising(node, hook):
                self._shutdown.note_finalising(node, hook)
            case control.Progress(node, text):
                self._shutdown.note_progress(node, text)
            case control.Shutdown(node, reason, drain_s):
                because = f": {reason}" if reason else ""
                why = f"{node} ended the project{because}" if node else reason
                self._shutdown.drain(why, drain_s, stopped=node)
            case control.Failed(node, text) if self._shutdown.counts_failure_of(node):
                self._processes.note_failure(node)
                first_line = (text.strip() or "no reason was given").splitlines()[0]
                self._shutdown.fail(f"node '{node}' failed: {first_line}")
            case control.Explanation(node, lines):
                if self._shutdown.phase is Phase.RUNNING:
                    self._output.log("WARN", f"{node} {'; '.join(lines)}")
            case control.Heard(node, text):
                self._peers.hear(node, text, time.monotonic())
            case control.Advance():
                self.pause.step(message.rounds, is_driven=self._detector.is_driven)
                self._settling.ask(link, message)
            case control.AtRest():
                if self._shutdown.phase is Phase.RUNNING:  # else the session hears of the end
                    self._settling.take(message)
            case control.Resume():
                self._settling.give_up(link)
                self.observers.take(link, message)
            case control.Interrupt():
                self._signals.append(signal.SIGINT)
            case _:
                self.observers.take(link, message)

    def _on_hello(self, link: ControlLink, hello: control.Hello) -> None:
        self._detector.greet(hello.nodes, hello.plugins, time.monotonic())
        if self._peers.exist:
            self._channels.send_to(link, control.Say(self._peers.own_state))
        if self.pause.is_on:
            self._channels.send_to(link, control.Pause())

    def _on_report(self, report: Report) -> None:
        now_s = time.monotonic()
        self.outcome.take(report, now_s)
        self._detector.report(report, now_s)
        self._backlog.report(report, now_s)
        if isinstance(report, control.Probed):
            self._probing.take(report)

    # ------------------------------------------------------------------ processes

    def _look_at_processes(self) -> None:
        ended = self._processes.ended()
        if ended:
            self._hear()  # what they said last has arrived by now
        for process, how in ended:
            is_stopping = self._shutdown.phase is Phase.STOPPING
            if not self._processes.may_end(process, is_stopping=is_stopping):
                self._shutdown.fail(
                    self._processes.how_it_failed(process, how, is_stopping=is_stopping),
                    exit_code=4 if process.is_abandoned else 1,
                )
            elif text := self._processes.how_it_left(process, how):
                self._output.log("WARN", text)

        for process in self._processes:
            if self._is_cut_off(process):
                self._shutdown.kill([process])
                self._shutdown.fail(
                    f"{nodes_of(process)} cannot be reached any more: the control connection was"
                    " closed at that end. Does a plugin close file descriptors that it has not"
                    " opened?"
                )

    def _is_cut_off(self, process: RunningNode) -> bool:
        """Whether a process goes on, though it has hung up and has not told its last."""
        for names, since_s in self._channels.parted.items():
            if {*names} & {*process.names} and time.monotonic() - since_s > _PARTED_S:
                return not self._processes.may_end(process, is_stopping=True)
        return False

    # ------------------------------------------------------------------ time

    def _pause_s(self, has_shown: bool) -> float:
        """Seconds until the next look; ``has_shown``: nodes are logging now."""
        if has_shown or self._shutdown.phase is not Phase.RUNNING:
            return _TICK_S
        end_s = self._end_s
        if end_s is None:
            return _QUIET_TICK_S
        return min(_QUIET_TICK_S, max(0.0, end_s - time.monotonic()))

    @property
    def _end_s(self) -> float | None:
        """When its duration is over, ``None``: never, or not known yet."""
        limit_s, started_s = self._duration_s, self.outcome.started_s
        if limit_s is None or started_s is None:
            return None
        return started_s + limit_s + self.pause.total_s - self._paused_before_s

    def _look_at_time(self) -> None:
        now_s = time.monotonic()
        still_s, self._looked_s = now_s - self._looked_s, now_s
        if still_s > _KEPT_STILL_S:  # then the nodes may have been stopped, too
            self._detector.excuse(still_s)
            self._backlog.begin_anew()
            self._shutdown.excuse(still_s)
        self._shutdown.heed_peers()
        if self._shutdown.phase is Phase.RUNNING and not self._start.is_over:
            self._look_at_start(now_s)
        self._shutdown.look(now_s)
        self._keep_pause()
        self._show(self._detector.remarks_on_hooks())
        if self._shutdown.phase in (Phase.RUNNING, Phase.DRAINING):
            self._show(self._detector.remarks_on_silence(now_s, self._processes.killed))
        self.observers.look_at(self._shutdown.phase)
        if self._shutdown.phase is Phase.RUNNING:
            self._look_at_run(now_s)

    def _look_at_start(self, now_s: float) -> None:
        if self._start.may_initialise():
            self._channels.send(control.Begin())
        if self._start.may_run():
            self.outcome.started_s = now_s
            self._paused_before_s = self.pause.total_s
            self._shutdown.end_of_start()  # hooks that send unasked would start before it
            self._channels.send(control.Activate())
            self._detector.begin_anew(now_s)  # until now nothing else could move
            self._backlog.begin_anew()

    def _show(self, remarks: Iterable[tuple[str, str]]) -> None:
        for severity, text in remarks:
            line, _, stack = text.partition("\n") if severity == "INFO" else (text, "", "")
            self._output.log(severity, line)
            if stack:
                self._output.log("DEBUG", f"{line}\n{stack}")

    def _keep_pause(self) -> None:
        """Note how long the run has stood still; nodes that are stopped meanwhile do not go on."""
        outcome = self.outcome
        outcome.is_paused = self.pause.is_on
        if outcome.started_s is not None:
            outcome.paused_s = self.pause.total_s - self._paused_before_s
        if self._shutdown.phase is Phase.STOPPING and outcome.is_paused:
            outcome.ending_s = self.pause.since_s

    def _look_at_run(self, now_s: float) -> None:
        if self.pause.is_on:
            self._detector.begin_anew(now_s)
            self._backlog.begin_anew()
            return
        end_s = self._end_s
        if end_s is not None and now_s >= end_s:
            self._shutdown.drain(f"{self._duration_s:g} s are over", DRAIN_S)
            return
        for source in (self._detector, self._backlog, self._peers):
            self._show(source.remarks(now_s))
        if self._start.is_over and self._detector.has_just_stalled(now_s):
            self._channels.send(control.Explain())
        if overdue := self._peers.overdue(now_s):
            self._shutdown.fail(overdue, exit_code=4)
        if self._peers.exist or not self._detector.is_complete:  # then not all can be asked
            return
        if self._probing.look(now_s, self._detector.rested_s(now_s)) is Verdict.DEAD:
            self._shutdown.fail(self._probing.why_dead())


def _hears_what_nobody_counts(files: Sequence[NodeFile]) -> bool:
    """Whether some connection may lose packets, or some input has an external topic."""
    connections = (c for file in files for c in file.connections)
    inputs = (port for file in files for port in file.node.inputs)
    return not all(c.is_reliable for c in connections) or any(p.external_topic for p in inputs)
