"""Shutdown of a run: its phases, and the events that end each of them.

Running, then perhaps draining, then stopping, and at worst killed; never back.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from neuros.control import Drain, Leave, Stop
from neuros.launcher.channels import Channels
from neuros.launcher.outcome import (
    EXIT_CODES,
    SIGNAL_NAMES,
    Outcome,
    Output,
    Phase,
    Processes,
    names_of,
    nodes_of,
)
from neuros.launcher.peers import Peers
from neuros.launcher.quiescence import Declarations, Probing, Verdict
from neuros.launcher.stall_detector import SILENT_S, StallDetector
from neuros.launcher.thread_reader import ThreadReader
from neuros.ports import RunningNode

STOP_S = 5.0
"""What a node has for its finalise hooks and for flushing, in all."""

# Reading where nodes stand begins so long before they are killed, and may hold that up for so long.
_READ_EARLY_S, _READ_S = 1.0, 0.5
# What closing a node that peers have heard may take, before it would be killed.
_CLOSING_S = 1.0


@dataclass
class Shutdown:
    """The phase of a run, and what leads to the next.

    Args:
        _signals: numbers of the signals that have arrived, appended to by a signal handler.
        _on_stop: called once nodes have been told to end.
    """

    _channels: Channels
    _processes: Processes
    _detector: StallDetector
    _reader: ThreadReader
    _declarations: Declarations
    _probing: Probing
    _peers: Peers
    _outcome: Outcome
    _output: Output
    _signals: list[int]
    _on_stop: Callable[[], object]
    phase: Phase = Phase.RUNNING
    _deadline_s: float = 0.0
    _begun: set[str] = field(default_factory=set)
    _kill_early_s: float = math.inf

    @property
    def is_hopeless(self) -> bool:
        """Whether something outlasts even SIGKILL; the reaper will try on for a while."""
        return self.phase is Phase.KILLED and time.monotonic() >= self._deadline_s

    def excuse(self, still_s: float) -> None:
        """The run stood still for so long: what nodes have for their end begins where it was."""
        self._deadline_s += still_s

    def drain(self, reason: str, drain_s: float, stopped: str = "") -> None:
        """Let packets under way arrive, and then end; only a run that is not ending already.

        ``stopped`` is the node that asks for it, and starts no further hook.
        """
        if self.phase is not Phase.RUNNING:
            return
        self.phase = Phase.DRAINING
        now_s = time.monotonic()
        self._outcome.begin_to_end(now_s)
        self._outcome.reason = reason
        self._deadline_s = now_s + drain_s
        self._output.log("INFO", f"{reason}; letting packets under way arrive")
        self._peers.drain(reason, drain_s)
        self._kill_not_begun()
        self._channels.send(Drain(self._declarations.last_round(stopped)))
        self._probing.drain(self._processes.killed, now_s)

    def let_begin(self, names: Sequence[str]) -> bool:
        """The nodes of a process are loaded; returns whether they may start hooks."""
        if self.phase is Phase.RUNNING:
            self._begun.update(names)
        return self.phase is Phase.RUNNING

    def note_finalising(self, node: str, hook: str | None) -> None:
        """A node finalises; one that shares its process has its time from when its turn comes."""
        is_next = not self._declarations.is_finalising(node)
        self._declarations.note_finalising(node, hook)
        process = self._processes.with_node(node)
        is_beside_others = process is not None and len(process.names) > 1
        if self.phase is Phase.STOPPING and is_next and is_beside_others:
            self._deadline_s = time.monotonic() + STOP_S

    def counts_failure_of(self, name: str) -> bool:
        """Whether it matters that a node fails: not if it was killed as the run ended well."""
        return bool(self._outcome.failures) or name not in self._processes.killed

    def give_up(self) -> None:
        """Kill what is left, whatever the phase, and let nothing begin any more."""
        self.phase = Phase.KILLED
        for process in self._processes:
            process.kill()

    def _kill_not_begun(self) -> None:
        """Kill what was not told to begin: nothing was sent by it or to it, no hook has run.

        It may be the only one here that can tell peers of the end, and has a moment for that.
        """
        for process in self._processes:
            if not {*process.names} & (self._begun | self._processes.killed):
                if self.phase is Phase.DRAINING:
                    self._output.log("INFO", f"{names_of(process)} had not started yet: killed")
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
                if self._begun.isdisjoint(process.names):
                    process.kill()
        if self.phase is Phase.STOPPING:
            self._look_at_stopping(now_s)
        elif self.phase is Phase.DRAINING:
            if self._probing.look(now_s, 0.0) is Verdict.DRAINED:
                self._outcome.has_drained = True
                self._stop()
            elif now_s >= self._deadline_s:
                why = "; ".join(self._probing.what_is_left(now_s)) or "packets keep coming"
                self._output.log("WARN", f"not drained in time: {why}")
                self._outcome.late_drain = why
                self._outcome.has_drained = True
                self._stop()

    def _look_at_stopping(self, now_s: float) -> None:
        left_s = self._deadline_s - now_s
        if left_s <= 0.0:
            for process in self._processes:
                self._fail_to_end(process, now_s)
            self._kill_all()
            return
        if left_s < _READ_EARLY_S:
            self._begin_to_read([*self._processes])
        if self._peers.exist and self._processes.have_reported():
            may_go = self._peers.finish(self._outcome.reports, now_s)
            if may_go or left_s < _CLOSING_S:
                self._channels.send(Leave())

    def _fail_to_end(self, process: RunningNode, now_s: float) -> None:
        """Its nodes have had their time."""
        if self._begun.isdisjoint(process.names):
            self._outcome.fail(
                f"{nodes_of(process)} had not started, and had not ended {STOP_S:g} s after it was"
                " killed"
            )
            return
        late = [name for name in process.names if not self._outcome.has_final_report(name)]
        unfinished = [clause for name in late for clause in self._unfinished(name, now_s)]
        why = "; ".join(unfinished) or "its process did not end"
        at_it = self._finalising_in(process)
        who = f"node '{at_it}'" if at_it else nodes_of(process)
        since = "it began to finalise" if at_it else "the end began"
        self._outcome.fail(f"{who} had to be killed {STOP_S:g} s after {since}: {why}")

    def _finalising_in(self, process: RunningNode) -> str:
        """The node that keeps the others of its process waiting while it finalises; else empty."""
        if len(process.names) == 1:
            return ""
        at_it = filter(self._declarations.is_finalising, process.names)
        return next((name for name in at_it if not self._outcome.has_final_report(name)), "")

    def _unfinished(self, name: str, now_s: float) -> list[str]:
        """Clauses about a node that has not made its final report."""
        hook, is_finalising = self._detector.executing(name), self._declarations.is_finalising(name)
        clauses = self._declarations.unfinished(name)
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
        self._deadline_s = now_s + STOP_S
        self._peers.stop(self._outcome.exit_code, self._outcome.reason)
        self._channels.send(Stop())
        self._kill_not_begun()
        self._on_stop()

    def _kill_all(self) -> None:
        self.phase = Phase.KILLED
        self.kill([*self._processes])
        self._deadline_s = time.monotonic() + STOP_S

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
