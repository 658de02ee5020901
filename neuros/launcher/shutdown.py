"""Shutdown of a run: its phases, and the events that end each of them.

Running, then perhaps draining, then stopping, and at worst killed; never back. A drained end that
is asked for while the run starts waits until every node is ready.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from neuros.control import Drain, Leave, Stop, StopHooks
from neuros.launcher.channels import Channels
from neuros.launcher.finalising import LEAVE_S, Finalising
from neuros.launcher.outcome import (
    EXIT_CODES,
    SIGNAL_NAMES,
    Outcome,
    Phase,
    Processes,
    SupervisorOutput,
    names_of,
    nodes_of,
)
from neuros.launcher.peers import Peers
from neuros.launcher.quiescence import Declarations, Probing, Verdict
from neuros.launcher.stall_detector import SILENT_S, StallDetector
from neuros.launcher.start import Start
from neuros.launcher.thread_reader import ThreadReader
from neuros.ports import RunningNode

DRAIN_S = 5.0
"""How long packets under way have to arrive, unless a plugin says otherwise."""

# Reading where nodes stand begins so long before they are killed, and may hold that up for so long.
_READ_EARLY_S, _READ_S = 1.0, 0.5
# What closing a node that peers have heard may take, before it is killed.
_CLOSING_S = 1.0
# How long a process may take to vanish once it is killed.
_KILLED_S = 5.0
# A plugin may tell its progress more often than a user can read it.
_TELL_S = 1.0


@dataclass
class Shutdown:
    """The phase of a run, and what leads to the next.

    Args:
        _signals: numbers of the signals that have arrived, appended to by a signal handler.
        _on_stop: called once nodes have been told to end.
        _may_wake: whether packets that nobody counts may have a hook start in a drained run: of
            connections that may lose some, and of external topics. What such a hook sent to a node
            that has stopped would be lost, so all hooks stop before any node does.

    Attributes:
        is_hopeless: whether something outlasts even SIGKILL; the reaper will try on for a while.
    """

    _channels: Channels
    _processes: Processes
    _detector: StallDetector
    _reader: ThreadReader
    _declarations: Declarations
    _start: Start
    _finalising: Finalising
    _probing: Probing
    _peers: Peers
    _outcome: Outcome
    _output: SupervisorOutput
    _signals: list[int]
    _on_stop: Callable[[], object]
    _may_wake: bool = False
    phase: Phase = Phase.RUNNING
    _deadline_s: float = 0.0
    _asked: tuple[str, float, str] | None = None  # a drained end, while the run starts
    _kill_early_s: float = math.inf
    is_hopeless: bool = False
    _told_s: dict[str, float] = field(default_factory=dict)

    def excuse(self, still_s: float) -> None:
        """The run stood still for so long: what nodes have for their end begins where it was."""
        self._deadline_s += still_s
        self._finalising.excuse(still_s)
        self._outcome.excuse(still_s)

    def drain(self, reason: str, drain_s: float, stopped: str = "") -> None:
        """Let packets under way arrive, and then end; only a run that is not ending already.

        ``stopped`` is the node that asks for it, and starts no further hook.
        """
        if self.phase is not Phase.RUNNING or self._asked is not None:
            return
        if not self._start.is_over:
            self._asked = reason, drain_s, stopped
            self._output.log("INFO", f"{reason}; the end comes once every node has initialised")
            return
        self.phase = Phase.DRAINING
        now_s = time.monotonic()
        self._outcome.begin_to_end(now_s)
        self._outcome.reason = reason
        self._deadline_s = now_s + drain_s
        self._output.log("INFO", f"{reason}; letting packets under way arrive")
        self._peers.drain(reason, drain_s)
        self._channels.send(Drain(self._declarations.last_round(stopped)))
        self._probing.drain(self._processes.killed, now_s)

    def end_of_start(self) -> None:
        """Time 0 of the run: where its end has been asked for, that comes now."""
        if self._asked is not None:
            asked, self._asked = self._asked, None
            self.drain(*asked)

    def note_finalising(self, node: str, hook: str | None) -> None:
        """A node starts a finalise hook, or closes what it holds, or has done so."""
        self._finalising.note_hook(node, hook, time.monotonic())

    def note_progress(self, node: str, text: str) -> None:
        """A node is getting on; its plugin may tell how far it has come."""
        now_s = time.monotonic()
        self._finalising.note_progress(node, now_s)
        if text and now_s - self._told_s.get(node, 0.0) >= _TELL_S:
            self._told_s[node] = now_s
            self._output.log("INFO", f"{node}: {text}")

    def counts_failure_of(self, name: str) -> bool:
        """Whether it matters that a node fails: not if it was killed as the run ended well."""
        return bool(self._outcome.failures) or name not in self._processes.killed

    def give_up(self) -> None:
        """Kill what is left, whatever the phase, and let nothing begin any more."""
        self.phase = Phase.KILLED
        for process in self._processes:
            process.kill()

    def _kill_not_begun(self) -> None:
        """Kill all if nodes were not told to begin: no hook has run, so there is nothing to save.

        They alone can tell peers of the end, and have a moment for that.
        """
        if self._start.has_begun:
            return
        for process in self._processes:
            if not self._processes.killed.issuperset(process.names):
                if self._peers.exist:
                    self._processes.killed.update(process.names)
                    self._channels.send_to_node(process.names[0], Stop())
                    self._kill_early_s = time.monotonic() + _CLOSING_S
                else:
                    self._processes.kill(process)

    def fail(self, reason: str, exit_code: int = 1) -> None:
        """End as failed, at once."""
        self._outcome.fail(reason, exit_code)
        if self.phase in (Phase.RUNNING, Phase.DRAINING):
            self._stop()

    def heed_signals(self) -> None:
        """End as the user wishes."""
        while self._signals:
            number = signal.Signals(self._signals.pop(0))
            name = SIGNAL_NAMES[number]
            if self.phase in (Phase.RUNNING, Phase.DRAINING):
                self._output.log("INFO", f"{name}: stopping (a second one kills at once)")
                self._stop_with(EXIT_CODES[number], f"ended by {name}")
                self._outcome.is_signalled = True
            elif self.phase is Phase.STOPPING and self._outcome.is_signalled:
                self._output.log("WARN", f"{name} again: killing what is left")
                self._outcome.end_by_force(EXIT_CODES[number], name)
                self._kill_all()
            elif self.phase is Phase.STOPPING:
                self._outcome.is_signalled = True
                self._output.log("INFO", f"{name}: already ending (a second one kills at once)")

    def heed_peers(self) -> None:
        """End where the project has ended elsewhere, and as it did there."""
        if self.phase not in (Phase.RUNNING, Phase.DRAINING):
            return
        end = self._peers.end(time.monotonic())
        if end is None:
            return
        if end.exit_code == 0:
            self.drain(end.reason, end.drain_s)
        elif end.exit_code in EXIT_CODES.values():
            self._output.log("INFO", f"{end.reason}; stopping")
            self._stop_with(end.exit_code, end.reason)
        else:
            self.fail(end.reason)

    def look(self, now_s: float) -> None:
        """Go on to the next phase where it is time."""
        if now_s >= self._kill_early_s:
            self._kill_early_s = math.inf
            for process in self._processes:
                process.kill()
        if self.phase is Phase.KILLED and now_s >= self._deadline_s and not self.is_hopeless:
            self.is_hopeless = True
            for process in self._processes:
                text = f"{nodes_of(process)} had not ended {_KILLED_S:g} s after it was killed"
                self._outcome.fail(text)
        elif self.phase is Phase.STOPPING:
            self._look_at_stopping(now_s)
        elif self.phase is Phase.DRAINING:
            if self._probing.look(now_s, 0.0) is Verdict.DRAINED:
                if self._may_wake:
                    self._may_wake = False
                    self._channels.send(StopHooks())
                    self._probing.drain(self._processes.killed, now_s)
                    return
                self._outcome.has_drained = True
                self._stop()
            elif now_s >= self._deadline_s:
                why = "; ".join(self._probing.what_is_left(now_s)) or "packets keep coming"
                self._output.log("WARN", f"not drained in time: {why}")
                self._outcome.late_drain = why
                self._outcome.has_drained = True
                self._stop()

    def _look_at_stopping(self, now_s: float) -> None:
        for text in self._finalising.remarks(now_s):
            self._output.log("INFO", text)
        running = [p for p in self._processes if not self._processes.killed.issuperset(p.names)]
        left = [(process, self._left_s(process, now_s)) for process in running]
        self._begin_to_read([process for process, left_s in left if left_s < _READ_EARLY_S])
        overdue = [process for process, left_s in left if left_s <= 0.0]
        for process in overdue:
            self._fail_to_end(process, now_s)
        self.kill(overdue)
        if len(overdue) == len(running):
            self._give_up_soon()
            return
        have_stopped = all(self._finalising.has_begun(process.names) for process in running)
        if have_stopped and self._peers.exist and self._peers.finish(self._outcome.reports, now_s):
            self._channels.send(Leave())

    def _left_s(self, process: RunningNode, now_s: float) -> float:
        """How long a process may go on without a sign of progress."""
        reported_s = [self._outcome.final_report_s(name) for name in process.names]
        if all(reported_s):
            return max(reported_s) + LEAVE_S - now_s
        return self._finalising.left_s(process.names, now_s)

    def _fail_to_end(self, process: RunningNode, now_s: float) -> None:
        """Its nodes have had their time."""
        late = [name for name in process.names if not self._outcome.has_final_report(name)]
        at_it = self._finalising_in(process)
        who = f"node '{at_it}'" if at_it else nodes_of(process)
        unfinished = [clause for name in late for clause in self._unfinished(name, now_s)]
        if late:
            limit_s = self._finalising.limits_s[at_it or late[0]]
            after, why = f"after {limit_s:g} s without progress", "; ".join(unfinished)
        else:
            after, why = f"{LEAVE_S:g} s after its final report", "its process did not end"
        self._outcome.fail(f"{who} had to be killed {after}: {why}")

    def _finalising_in(self, process: RunningNode) -> str:
        """The node that keeps the others of its process waiting while it finalises; else empty."""
        return self._finalising.current(process.names) if len(process.names) > 1 else ""

    def _unfinished(self, name: str, now_s: float) -> list[str]:
        """Clauses about a node that has not made its final report."""
        hook, is_finalising = self._detector.executing(name), self._finalising.has_begun([name])
        clauses = self._finalising.unfinished(name)
        if hook and not is_finalising:
            clauses.insert(0, f"'{name}' was still executing '{hook}'")
        if clauses:
            return clauses
        if is_finalising:
            return [f"'{name}' had finalised, but did not make its final report"]
        silent_s = self._detector.silent_s(name, now_s)
        silence = f" and had not reported for {silent_s:.0f} s" if silent_s >= SILENT_S else ""
        return [f"'{name}' did not begin to finalise{silence}"]

    def _stop_with(self, exit_code: int, reason: str) -> None:
        self._outcome.exit_code, self._outcome.reason = exit_code, reason
        self._stop()

    def _stop(self) -> None:
        self.phase = Phase.STOPPING
        now_s = time.monotonic()
        self._outcome.begin_to_end(now_s)
        self._finalising.begin(now_s)
        self._peers.stop(self._outcome.exit_code, self._outcome.reason)
        self._channels.send(Stop())
        self._kill_not_begun()
        self._on_stop()

    def _kill_all(self) -> None:
        self.kill([*self._processes])
        self._give_up_soon()

    def _give_up_soon(self) -> None:
        """All are killed; what outlasts that is left to the reaper after a while."""
        self.phase = Phase.KILLED
        self._deadline_s = time.monotonic() + _KILLED_S

    def kill(self, processes: Sequence[RunningNode]) -> None:
        """Kill processes, and tell where their nodes stood."""
        self._begin_to_read(processes)
        self._reader.wait(_READ_S)
        now_s = time.monotonic()
        stood = [(process, *self._detector.where(process.names, now_s)) for process in processes]
        for process in processes:
            self._processes.kill(process)
        for process, texts, read in stood:
            if at_it := self._finalising_in(process):  # others may be of the same plugin
                texts = {name: text for name, text in texts.items() if name == at_it}
            for name, text in texts.items():
                self._output.log("ERROR", f"{name} was at this point when it was killed:\n{text}")
            if not texts and read.threads:
                texts[process.names[0]] = str(read)
                text = f"where the threads of {names_of(process)} stood when killed:\n{read}"
                self._output.log("ERROR", text)
            elif not texts and read.problem:
                text = f"where {names_of(process)} stood when killed is not known: {read.problem}"
                self._output.log("WARN", text)
            self._outcome.stacks.update(texts)

    def _begin_to_read(self, processes: Sequence[RunningNode]) -> None:
        for process in processes:
            self._reader.begin(process.names[0])
