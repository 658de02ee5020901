"""Supervises a run: starts its nodes, watches them, and brings it to its end.

The supervisor takes no part in the data path. It hears of the nodes over the control channel, of
their processes from the back end, and of the user by signals; all in one thread, which never waits
for a node or for a reader of its output.

A run starts, runs, then perhaps drains, stops, and at worst is killed; a phase never comes back.
What each event leads to in each phase is one table, :data:`_ACTIONS`, at the end of this module.
"""

from __future__ import annotations

import math
import signal
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import neuros.control as control
from neuros.control import Message, Report
from neuros.control.link import ControlLink
from neuros.errors import ControlError
from neuros.launcher.channels import Channels, Observers, PauseState
from neuros.launcher.nodes import LEAVE_S, NodeView, finalising, left_s
from neuros.launcher.outcome import (
    EXIT_CODES,
    SIGNAL_NAMES,
    Outcome,
    Phase,
    SupervisorOutput,
    names_of,
    nodes_of,
)
from neuros.launcher.peers import EndElsewhere, Peers, Stage
from neuros.launcher.quiescence import Declarations, Probing, Verdict, connections_among
from neuros.launcher.stall_detector import SILENT_S, Backlog, StallDetector, ThreadReader
from neuros.ports import ControlListener, Launcher, RunningNode
from neuros.project.model import NodeFile

# How often clocks and logs are looked at: everything else wakes the supervisor by itself.
_TICK_S = 0.02
_QUIET_TICK_S = 0.2
_MOST_REFUSED = 10
_PARTED_S = 1.0
"""A process that has hung up ends within this time, or something has closed its descriptors."""
_KEPT_STILL_S = 1.0
"""Between two ticks there is a fifth of that, unless this process may not run."""
_DRAIN_S = 5.0
"""How long packets under way have to arrive, unless a plugin says otherwise."""
# Reading where nodes stand begins so long before they are killed, and may hold that up for so long.
_READ_EARLY_S, _READ_S = 1.0, 0.5
# What closing a node that peers have heard may take, before it is killed.
_CLOSING_S = 1.0
# How long a process may take to vanish once it is killed.
_KILLED_S = 5.0
# A plugin may tell its progress more often than a user can read it.
_TELL_S = 1.0


class RunEvent(Enum):
    """What happens to a run."""

    TICK = "time has passed, or something has arrived"
    END = "a drained end is asked for: reason, drain_s, the node that asks for it"
    ENDED_ELSEWHERE = "peers have come to their end: a peers.EndElsewhere"
    FAILURE = "a node or the run has failed"
    SIGNAL = "the user has sent a signal: its number"


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
        phase: of the run.
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
        self._output = output
        self._signals = signals
        self._wishes = [] if wishes is None else wishes
        self._duration_s = duration_s
        self._peers = peers or Peers("", (), files)
        self._on_stop = on_stop
        self._nodes: dict[str, NodeView] = {}
        for file in files:
            name, limit_s = file.node.name, finalise_s or file.node.finalise_s
            self._nodes[name] = NodeView(name, limit_s, run_folder / name)
        connections = connections_among(files)

        self.phase = Phase.STARTING
        self.outcome = Outcome()
        self._channels = Channels(listener)
        if waker is not None:
            self._channels.wake_on(waker)
        self._peers.publish_through(lambda text: self._channels.send(control.PublishState(text)))
        self._processes: list[RunningNode] = []  # that run
        self._reader = ThreadReader(
            lambda name: next((each for each in self._processes if name in each.names), None)
        )
        self._detector = StallDetector(self._nodes, time.monotonic(), self._reader)
        self._backlog = Backlog(connections, self._detector.is_held_up)
        peers_to_ask = self._peers if self._peers.exist else None
        self._probing = Probing(
            self._nodes,
            connections,
            self._channels.send,
            peers_to_ask,
            lambda: all(node.is_there for node in self._nodes.values()),
        )
        self._session: ControlLink | None = None  # it waits for the end of a step
        self._declarations = Declarations(files)
        self.pause = PauseState(self._channels.send, time.monotonic)
        if is_held:
            self.pause.begin()
        external = {
            (file.node.name, port.name)
            for file in files
            for port in file.node.inputs
            if port.external_topic is not None
        }
        self.observers = Observers(
            self._channels,
            self.pause,
            lambda: self._detector.is_driven,
            lambda reason: self._handle(RunEvent.END, reason),
            external if is_held else (),
        )
        # Packets that nobody counts may have a hook start in a drained run: those of connections
        # that may lose some, and of external topics. What such a hook sends to a node that has
        # stopped would be lost, so all hooks stop before any node does.
        self._stops_hooks_first = not self._peers.exist and bool(
            external or not all(c.is_reliable for file in files for c in file.connections)
        )

        self._has_begun = False  # whether nodes have been told to initialise
        self._end_asked: tuple[Any, ...] | None = None  # while the run starts
        self._paused_before_s = 0.0  # time 0 of the run
        self._deadline_s = 0.0  # of draining, or of processes that were killed
        self._kill_early_s = math.inf
        self._is_hopeless = False  # something outlasts even SIGKILL; the guardian tries on
        self._told_s: dict[str, float] = {}
        self._refused: set[ControlLink] = set()
        self._refused_count = 0
        self._last_tick_s = time.monotonic()

    def run(self) -> Outcome:
        """Start everything and stay until all of it has ended. Raises ``EnvironmentFault``."""
        try:
            self._handle_requests()  # one may have come before anything was started
            if self.phase is Phase.STARTING:
                self._processes = [*self._launcher.start(self._files, self._environment)]
            has_shown = True
            self._last_tick_s = time.monotonic()
            while self._processes and not self._is_hopeless:
                self._channels.wait(self._pause_s(has_shown))
                self._handle_requests()
                self._receive()
                self._check_processes()
                self._tick()
                self._channels.flush()
                has_shown = bool(self._output.poll())
        finally:
            self.phase = Phase.KILLED
            for process in self._processes:
                process.kill()
            self._reader.close()
            self._receive()
            self.observers.end(self.outcome)
            self._channels.close()
            self.outcome.elsewhere = self._peers.counters()
            self.outcome.ended_s = time.monotonic()
        return self.outcome

    def _handle(self, event: RunEvent, *details: Any) -> None:
        """Do what an event leads to in this phase; it may be nothing."""
        action = _ACTIONS.get((self.phase, event))
        if action is not None:
            action(self, *details)

    def _fail(self, reason: str, exit_code: int = 1) -> None:
        """Keep a failure, in any phase; the first one ends the run."""
        self.outcome.fail(reason, exit_code)
        self._handle(RunEvent.FAILURE)

    def _log(self, severity: str, text: str) -> None:
        self._output.log(severity, text)
        self.observers.tell(control.LogRecord(severity, text))

    # ------------------------------------------------------------------ what arrives

    def _handle_requests(self) -> None:
        """End as the user wishes, or the program that has started the run."""
        while self._signals:
            self._handle(RunEvent.SIGNAL, signal.Signals(self._signals.pop(0)))
        while self._wishes:
            reason, exit_code = self._wishes.pop(0)
            if not exit_code:
                self._handle(RunEvent.END, reason)
            elif self.phase in _BEFORE_STOP:
                self._fail(reason, exit_code)

    def _receive(self) -> None:
        for link, message in self._channels.receive():
            try:
                if isinstance(message, ControlError):
                    raise message
                self._on_message(link, message)
            except ControlError as error:
                self._refuse(link, error)

    def _refuse(self, link: ControlLink, error: ControlError) -> None:
        """A message is wrong: without it, nothing is known of a node for sure."""
        if self._channels.nodes_of(link):
            if link not in self._refused:
                self._refused.add(link)
                self._fail(f"control channel: {error}")
        elif self._channels.has(link):
            self._channels.hang_up(link)
            self._refused_count += 1
            if self._refused_count <= _MOST_REFUSED:
                text = f"control channel: a connection was closed: {error}"
                is_last = self._refused_count == _MOST_REFUSED
                self._log("WARN", text + "; further ones are not shown" * is_last)

    def _on_message(self, link: ControlLink, message: Message) -> None:
        now_s = time.monotonic()
        if (senders := self._channels.nodes_of(link)) and not isinstance(
            message, control.StateOfPeer
        ):
            for name in (*senders, getattr(message, "node", "")):
                if name and name not in self._nodes:
                    raise ControlError(f"this run has no node '{name}'")
        match message:
            case Report():
                self._extend_drain(message, now_s)
                self.outcome.add(message, now_s)
                self._detector.report(message, now_s)
                self._backlog.report(message, now_s)
            case control.Probed():
                self._probing.add(message, now_s)
                if self._session is not None and self._probing.verdict is Verdict.AT_REST:
                    # A pause takes back what hooks could not use of a step.
                    self._channels.send(control.Pause(self._probing.virtual_ns))
                    self._channels.send_to(self._session, self._probing.end_rest())
                    self._session = None
            case control.Hello(nodes, plugins):
                for name in nodes:
                    self._nodes[name].connect(nodes, plugins, now_s)
                if self._peers.exist:
                    self._channels.send_to(link, control.PublishState(self._peers.own_state))
                if self.pause.is_on:
                    self._channels.send_to(link, control.Pause())
            case control.Ready(node):
                self._nodes[node].is_ready = True
            case control.Hooks(node):
                self._declarations.add(message)
                self._nodes[node].hooks_left = list(message.finalise)
                self._nodes[node].is_loaded = True
            case control.Finalising(node, hook):
                self._nodes[node].enter(hook, now_s)
            case control.Progress(node, text):
                self._nodes[node].advance(now_s)
                if text and now_s - self._told_s.get(node, 0.0) >= _TELL_S:
                    self._told_s[node] = now_s
                    self._log("INFO", f"{node}: {text}")
            case control.Shutdown(node, reason, drain_s):
                because = f": {reason}" if reason else ""
                why = f"{node} ended the project{because}" if node else reason
                self._handle(RunEvent.END, why, drain_s, node, True)
            case control.Failed(node, text):
                # Of a run that ends well, the failure of a node that was killed does not matter.
                if self.outcome.failures or not self._nodes[node].is_killed:
                    self._nodes[node].has_failed = True
                    first_line = (text.strip() or "no reason was given").splitlines()[0]
                    self._fail(f"node '{node}' failed: {first_line}")
            case control.StateOfPeer(node, text):
                self._peers.receive(node, text, now_s)
            case control.Advance():
                is_driven, virtual_ns = self._detector.is_driven, message.virtual_ns
                self.pause.step(message.rounds, is_driven=is_driven, virtual_ns=virtual_ns)
                if self.phase in _BEFORE_END:  # else the session hears of the end
                    self._session = link
                    self._probing.await_rest(message, now_s)
            case control.Resume():
                if link is self._session:
                    self._session = None
                    self._probing.end_rest()
                self.observers.receive(link, message)
            case control.Interrupt():
                self._signals.append(signal.SIGINT)
            case _:
                self.observers.receive(link, message)

    # ------------------------------------------------------------------ processes

    def _check_processes(self) -> None:
        ended = [(process, how) for process in self._processes if (how := process.poll())]
        if ended:
            gone = [process for process, _ in ended]
            self._processes = [each for each in self._processes if each not in gone]
            self._receive()  # what they said last has arrived by now
        for process, how in ended:
            if not self._may_end(process, is_stopping=self.phase is Phase.STOPPING):
                text = f"{nodes_of(process)} ended {self._when_it_ended(process)}: {how}"
                self._fail(text, exit_code=4 if process.is_abandoned else 1)
            elif how != "exit code 0" and not any(
                node.is_killed or node.has_failed for node in self._nodes_of(process)
            ):
                text = f"the process of {nodes_of(process)} ended badly after its final report"
                self._log("WARN", f"{text}: {how}")

        for process in self._processes:
            if self._is_cut_off(process):
                self._kill([process])
                self._fail(
                    f"{nodes_of(process)} cannot be reached any more: the control connection was"
                    " closed at that end. Does a plugin close file descriptors that it has not"
                    " opened?"
                )

    def _may_end(self, process: RunningNode, *, is_stopping: bool) -> bool:
        """Whether its nodes have made their final reports, or have reported a failure."""
        if self._is_killed(process) or any(node.has_failed for node in self._nodes_of(process)):
            return True
        return is_stopping and all(map(self.outcome.has_final_report, process.names))

    def _when_it_ended(self, process: RunningNode) -> str:
        """When a process has ended that should not have."""
        if self.phase is Phase.STOPPING:
            return "while finalising"
        if any(node.is_there for node in self._nodes_of(process)):
            return f"unexpectedly{''.join(map(self._detector.last_seen, process.names))}"
        were = "it was up (what it" if len(process.names) == 1 else "they were up (what they"
        return f"before {were} wrote is above)"

    def _is_cut_off(self, process: RunningNode) -> bool:
        """Whether a process runs on without its control connection, before its final reports."""
        for names, since_s in self._channels.parted.items():
            if {*names} & {*process.names} and time.monotonic() - since_s > _PARTED_S:
                return not self._may_end(process, is_stopping=True)
        return False

    def _kill(self, processes: Sequence[RunningNode]) -> None:
        """Kill processes, and log where their nodes stood."""
        self._begin_to_read(processes)
        self._reader.wait(_READ_S)
        now_s = time.monotonic()
        stood = [(process, *self._detector.where(process.names, now_s)) for process in processes]
        for process in processes:
            self._mark_as_killed(process)
            process.kill()
        for process, texts, read in stood:
            if at_it := self._finalising_in(process):  # others may be of the same plugin
                texts = {name: text for name, text in texts.items() if name == at_it}
            for name, text in texts.items():
                self._log("ERROR", f"{name} was at this point when it was killed:\n{text}")
            if not texts and read.threads:
                texts[process.names[0]] = str(read)
                text = f"where the threads of {names_of(process)} stood when killed:\n{read}"
                self._log("ERROR", text)
            elif not texts and read.problem:
                text = f"where {names_of(process)} stood when killed is not known: {read.problem}"
                self._log("WARN", text)
            self.outcome.stacks.update(texts)

    def _mark_as_killed(self, process: RunningNode) -> None:
        for node in self._nodes_of(process):
            node.is_killed = True

    def _is_killed(self, process: RunningNode) -> bool:
        return all(node.is_killed for node in self._nodes_of(process))

    @property
    def _killed(self) -> list[str]:
        return [node.name for node in self._nodes.values() if node.is_killed]

    def _begin_to_read(self, processes: Sequence[RunningNode]) -> None:
        for process in processes:
            self._reader.begin(process.names[0])

    # ------------------------------------------------------------------ time

    def _pause_s(self, has_shown: bool) -> float:
        """Seconds until the next tick; ``has_shown``: nodes are logging now."""
        is_busy = has_shown or self.phase not in _BEFORE_END
        longest_s = _TICK_S if is_busy else _QUIET_TICK_S
        if self.phase not in _BEFORE_STOP:
            return longest_s
        due_s = min(self._probing.due_s, math.inf if is_busy else self._end_s)
        return min(longest_s, max(0.0, due_s - time.monotonic()))

    @property
    def _end_s(self) -> float:
        """When its duration is over; infinite: never, or not known yet."""
        limit_s, started_s = self._duration_s, self.outcome.started_s
        if limit_s is None or started_s is None:
            return math.inf
        return started_s + limit_s + self.pause.total_s - self._paused_before_s

    def _tick(self) -> None:
        now_s = time.monotonic()
        still_s, self._last_tick_s = now_s - self._last_tick_s, now_s
        if still_s > _KEPT_STILL_S:  # then the nodes may have been stopped, too
            self._detector.shift(still_s)
            self._backlog.begin_anew()
            self._deadline_s += still_s
            for node in self._nodes.values():
                node.shift(still_s)
        if end := self._peers.end(now_s):
            self._handle(RunEvent.ENDED_ELSEWHERE, end)
        self._handle(RunEvent.TICK, now_s)
        self.outcome.is_paused = self.pause.is_on
        if self.outcome.started_s is not None:
            self.outcome.paused_s = self.pause.total_s - self._paused_before_s
        self._show(self._detector.remarks_on_hooks())
        if self.phase in _BEFORE_STOP:
            self._show(self._detector.remarks_on_silence(now_s))
        # To observers, a run that starts is running.
        self.observers.update(Phase.RUNNING if self.phase is Phase.STARTING else self.phase)

    def _show(self, remarks: Iterable[tuple[str, str]]) -> None:
        for severity, text in remarks:
            line, _, stack = text.partition("\n") if severity == "INFO" else (text, "", "")
            self._log(severity, line)
            if stack:
                self._log("DEBUG", f"{line}\n{stack}")

    # ------------------------------------------------------------------ starting and running

    def _tick_starting(self, now_s: float) -> None:
        """Every plugin loads, here and at peers; then nodes initialise; then the run begins."""
        if all(node.is_loaded for node in self._nodes.values()):
            self._peers.reach(Stage.LOADED)
            if not self._has_begun and self._peers.have_reached(Stage.LOADED):
                self._has_begun = True
                self._channels.send(control.Begin())
        if all(node.is_ready for node in self._nodes.values()):
            self._peers.reach(Stage.READY)
            if self._peers.have_reached(Stage.READY):
                self._begin_to_run(now_s)
        self._tick_running(now_s)

    def _begin_to_run(self, now_s: float) -> None:
        """Time 0 of the run: every node of the project has initialised."""
        self.phase = Phase.RUNNING
        self.outcome.started_s = now_s
        self._paused_before_s = self.pause.total_s
        if self._end_asked is not None:  # hooks that send unasked would start before it
            self._drain(*self._end_asked)
        self._channels.send(control.Activate())
        self._detector.begin_anew(now_s)  # until now nothing else could move
        self._backlog.begin_anew()

    def _tick_running(self, now_s: float) -> None:
        if self.phase not in _BEFORE_END:
            return
        if self._session is not None:
            self._probing.check(now_s, 0.0)
        if self.pause.is_on:
            self._detector.begin_anew(now_s)
            self._backlog.begin_anew()
            return
        if now_s >= self._end_s:
            self._drain(f"{self._duration_s:g} s are over")
            return
        for source in (self._detector, self._backlog, self._peers):
            self._show(source.remarks(now_s))
        if self.phase is Phase.RUNNING and self._detector.has_just_stalled(now_s):
            self._show(self._detector.reasons(now_s))
        if overdue := self._peers.overdue(now_s):
            self._fail(overdue, exit_code=4)
        if self._peers.exist or not self._detector.is_complete:  # then not all can be asked
            return
        if self._probing.check(now_s, self._detector.rested_s(now_s)) is Verdict.DEAD:
            self._fail(self._probing.why_dead())

    # ------------------------------------------------------------------ draining

    def _end_once_started(self, reason: str, *details: Any) -> None:
        if self._end_asked is None:
            self._end_asked = reason, *details
            self._log("INFO", f"{reason}; the end comes once every node has initialised")

    def _drain(
        self, reason: str, drain_s: float = _DRAIN_S, stopped: str = "", is_asked: bool = False
    ) -> None:
        """Drain: wait until packets under way have arrived, then end.

        Args:
            stopped: the node that asks for it, and starts no further hook.
            is_asked: whether it is a node, or the duration of a run in virtual time.
        """
        self.phase = Phase.DRAINING
        now_s = time.monotonic()
        self.outcome.begin_to_end(now_s)
        self.outcome.reason = reason
        self._deadline_s = now_s + drain_s
        self._log("INFO", f"{reason}; letting packets under way arrive")
        self._peers.drain(reason, drain_s)
        self._channels.send(control.Drain(self._declarations.last_round(stopped), is_asked))
        self._probing.drain(self._killed, now_s)

    def _extend_drain(self, report: Report, now_s: float) -> None:
        """In virtual time, nodes know how long they may drain; here, whether they get on."""
        last = self.outcome.reports.get(report.node)
        last_s = None if last is None else last.virtual_s
        if self.phase is Phase.DRAINING and (report.virtual_s or 0.0) > (last_s or 0.0):
            self._deadline_s = max(self._deadline_s, now_s + _DRAIN_S)

    def _tick_draining(self, now_s: float) -> None:
        if self._probing.check(now_s, 0.0) is Verdict.DRAINED:
            if self._stops_hooks_first:
                self._stops_hooks_first = False
                self._channels.send(control.StopHooks())
                self._probing.drain(self._killed, now_s)
                return
        elif now_s >= self._deadline_s:
            why = "; ".join(self._probing.what_is_left(now_s)) or "packets keep coming"
            self._log("WARN", f"not drained in time: {why}")
            self.outcome.late_drain = why
        else:
            return
        self.outcome.has_drained = True
        self._stop()

    # ------------------------------------------------------------------ stopping

    def _end_as_elsewhere(self, end: EndElsewhere) -> None:
        """End where the project has ended elsewhere, and as it did there."""
        if end.exit_code == 0:
            self._handle(RunEvent.END, end.reason, end.drain_s)
        elif end.exit_code in EXIT_CODES.values():
            self._log("INFO", f"{end.reason}; stopping")
            self._stop_with(end.exit_code, end.reason)
        else:
            self._fail(end.reason)

    def _stop_by_signal(self, number: signal.Signals) -> None:
        name = SIGNAL_NAMES[number]
        self._log("INFO", f"{name}: stopping (a second one kills at once)")
        self._stop_with(EXIT_CODES[number], f"ended by {name}")
        self.outcome.is_signalled = True

    def _on_further_signal(self, number: signal.Signals) -> None:
        name = SIGNAL_NAMES[number]
        if not self.outcome.is_signalled:  # the run ends for another cause
            self.outcome.is_signalled = True
            self._log("INFO", f"{name}: already ending (a second one kills at once)")
            return
        self._log("WARN", f"{name} again: killing what is left")
        self.outcome.end_by_force(EXIT_CODES[number], name)
        self._kill(self._processes)
        self._wait_for_killed()

    def _stop_with(self, exit_code: int, reason: str) -> None:
        self.outcome.exit_code, self.outcome.reason = exit_code, reason
        self._stop()

    def _stop(self) -> None:
        """Have all nodes finalise and end."""
        self.phase = Phase.STOPPING
        now_s = time.monotonic()
        self.outcome.begin_to_end(now_s)
        if self.pause.is_on:  # nodes do not go on before they end
            self.outcome.ending_s = self.pause.since_s
        for node in self._nodes.values():
            node.begin_to_end(now_s)
        self._peers.stop(self.outcome.exit_code, self.outcome.reason)
        self._channels.send(control.Stop())
        if not self._has_begun:  # no hook has run, so there is nothing to save
            for process in self._processes:
                if self._is_killed(process):
                    continue
                self._mark_as_killed(process)
                if self._peers.exist:  # nodes alone can tell peers of the end
                    self._kill_early_s = now_s + _CLOSING_S
                else:
                    process.kill()
        self._on_stop()

    def _tick_stopping(self, now_s: float) -> None:
        for node in self._nodes.values():
            if text := node.saving(now_s):
                self._log("INFO", text)
        running = [process for process in self._processes if not self._is_killed(process)]
        left = [(process, self._left_s(process, now_s)) for process in running]
        self._begin_to_read([process for process, left_s in left if left_s < _READ_EARLY_S])
        overdue = [process for process, left_s in left if left_s <= 0.0]
        for process in overdue:
            self.outcome.fail(self._why_killed(process, now_s))
        self._kill(overdue)
        if len(overdue) == len(running):
            self._wait_for_killed()
            return
        have_stopped = all(any(n.has_stopped for n in self._nodes_of(p)) for p in running)
        if have_stopped and self._peers.exist and self._peers.finish(self.outcome.reports, now_s):
            self._channels.send(control.Leave())

    def _left_s(self, process: RunningNode, now_s: float) -> float:
        """How long a process may go on without a sign of progress."""
        nodes = self._nodes_of(process)
        if all(map(self.outcome.has_final_report, process.names)):
            return LEAVE_S - min(node.silent_s(now_s) for node in nodes)
        return left_s(nodes, now_s)

    def _why_killed(self, process: RunningNode, now_s: float) -> str:
        """A sentence about a process whose nodes have had their time."""
        late = [name for name in process.names if not self.outcome.has_final_report(name)]
        at_it = self._finalising_in(process)
        who = f"node '{at_it}'" if at_it else nodes_of(process)
        if not late:
            after, why = f"{LEAVE_S:g} s after its final report", "its process did not end"
        else:
            limit_s = self._nodes[at_it or late[0]].finalise_s
            clauses = [clause for name in late for clause in self._unfinished(name, now_s)]
            after, why = f"after {limit_s:g} s without progress", "; ".join(clauses)
        return f"{who} had to be killed {after}: {why}"

    def _finalising_in(self, process: RunningNode) -> str:
        """The node that keeps the others of its process waiting while it finalises; else empty."""
        node = finalising(self._nodes_of(process)) if len(process.names) > 1 else None
        return node.name if node else ""

    def _nodes_of(self, process: RunningNode) -> list[NodeView]:
        return [self._nodes[name] for name in process.names]

    def _unfinished(self, name: str, now_s: float) -> list[str]:
        """Clauses about a node that has not made its final report."""
        node, hook = self._nodes[name], self._detector.executing(name)
        clauses = node.unfinished()
        if hook and not node.has_stopped:
            clauses.insert(0, f"'{name}' was still executing '{hook}'")
        if clauses:
            return clauses
        if node.has_stopped:
            return [f"'{name}' had finalised, but did not make its final report"]
        silent_s = node.silent_s(now_s)
        silence = f" and had not reported for {silent_s:.0f} s" if silent_s >= SILENT_S else ""
        return [f"'{name}' did not begin to finalise{silence}"]

    def _wait_for_killed(self) -> None:
        """All are killed; what outlasts that is left to the guardian after a while."""
        self.phase = Phase.KILLED
        self._deadline_s = time.monotonic() + _KILLED_S

    def _tick_killed(self, now_s: float) -> None:
        if now_s >= self._kill_early_s:
            self._kill_early_s = math.inf
            for process in self._processes:
                process.kill()
        if now_s >= self._deadline_s:
            self._is_hopeless = True
            for process in self._processes:
                text = f"{nodes_of(process)} had not ended {_KILLED_S:g} s after it was killed"
                self.outcome.fail(text)


_BEFORE_END = {Phase.STARTING, Phase.RUNNING}
_BEFORE_STOP = {*_BEFORE_END, Phase.DRAINING}

_ACTIONS: Mapping[tuple[Phase, RunEvent], Callable[..., None]] = {
    (Phase.STARTING, RunEvent.TICK): Supervisor._tick_starting,
    (Phase.RUNNING, RunEvent.TICK): Supervisor._tick_running,
    (Phase.DRAINING, RunEvent.TICK): Supervisor._tick_draining,
    (Phase.STOPPING, RunEvent.TICK): Supervisor._tick_stopping,
    (Phase.KILLED, RunEvent.TICK): Supervisor._tick_killed,
    (Phase.STARTING, RunEvent.END): Supervisor._end_once_started,
    (Phase.RUNNING, RunEvent.END): Supervisor._drain,
    **{(phase, RunEvent.ENDED_ELSEWHERE): Supervisor._end_as_elsewhere for phase in _BEFORE_STOP},
    **{(phase, RunEvent.FAILURE): Supervisor._stop for phase in _BEFORE_STOP},
    **{(phase, RunEvent.SIGNAL): Supervisor._stop_by_signal for phase in _BEFORE_STOP},
    (Phase.STOPPING, RunEvent.SIGNAL): Supervisor._on_further_signal,
}
"""What an event leads to in a phase; pairs that are not listed lead to nothing."""
