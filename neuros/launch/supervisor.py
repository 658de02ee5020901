"""Starts a project, watches it, and brings it to its end, however that comes.

The supervisor takes no part in the data path. It hears of the nodes over the control channel, of
their processes from the back end, and of the user by signals; all in one thread.
"""

from __future__ import annotations

import selectors
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Protocol

from neuros.control import Lines, listen
from neuros.launch.quiescence import counters, cycle, is_dead, is_drained, waits
from neuros.launch.watch import Watch
from neuros.ports import Launcher, RunningNode
from neuros.project.model import Connection, NodeFile

STOP_S = 5.0
"""What nodes have for their finalise hooks and for flushing, in all."""

_TICK_S = 0.02
_DEADLOCK_AFTER_S = 1.0


class Phase(Enum):
    """Where a run is in its life."""

    RUNNING = "running"
    DRAINING = "draining"
    STOPPING = "stopping"
    KILLED = "killed"


class Output(Protocol):
    """Where the supervisor writes for people."""

    def log(self, severity: str, text: str) -> None: ...
    def poll(self) -> object: ...


@dataclass
class Outcome:
    """How a run ended.

    Attributes:
        exit_code: 0 ended normally, 1 a node failed or deadlock, 130 and 143 by signal.
        reason: one line for the user.
        reports: the last report of every node that made one.
        report_times_s: when that was, on the monotonic clock.
        started_s: when the first hook started, ``None`` if none did.
        ending_s: when the end was asked for first: what comes after is draining and finalising.
    """

    exit_code: int = 0
    reason: str = ""
    reports: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    report_times_s: dict[str, float] = field(default_factory=dict)
    started_s: float | None = None
    ending_s: float | None = None
    ended_s: float = 0.0
    failures: list[str] = field(default_factory=list)


class Supervisor:
    """Runs one project on one back end.

    Args:
        files: the nodes to start; ``connections`` among them.
        launcher: the back end.
        environment: added to the environment of every node.
        run_folder: the control socket is put there.
        output: for log records; its ``poll`` shows what nodes have logged.
        signals: numbers of the signals that have arrived, appended to by a signal handler.
        duration_s: wall time from the first hook to a drained end, ``None``: no limit.
        is_partial: whether nodes that are not started here may be running elsewhere.
    """

    def __init__(
        self,
        files: Sequence[NodeFile],
        launcher: Launcher,
        environment: Mapping[str, str],
        run_folder: Path,
        output: Output,
        signals: list[int],
        *,
        duration_s: float | None = None,
        is_partial: bool = False,
    ) -> None:
        self._files = files
        self._launcher = launcher
        self._environment = environment
        self._output = output
        self._signals = signals
        self._duration_s = duration_s
        self._is_partial = is_partial
        names = {file.node.name for file in files}
        self._connections: list[Connection] = sorted(
            {
                connection
                for file in files
                for connection in file.connections
                if {connection.source_node, connection.destination_node} <= names
            },
            key=lambda connection: connection.index,
        )
        self._phase = Phase.RUNNING
        self._deadline_s = 0.0
        self._processes: list[RunningNode] = []
        self._lines: dict[Lines, tuple[str, ...]] = {}
        self._listening = listen(run_folder)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listening, selectors.EVENT_READ, self._accept)
        self._watch = Watch([file.node.name for file in files])
        self._probes: dict[str, Mapping[str, Any]] = {}
        self._probe_number = 0
        self._probe_sent_s = 0.0
        self._last_round: tuple[Any, ...] | None = None
        self.outcome = Outcome()

    def run(self) -> Outcome:
        """Start everything and stay until all of it has ended."""
        try:
            self._processes = list(self._launcher.start(self._files, self._environment))
            while self._processes:
                for key, _ in self._selector.select(_TICK_S):
                    key.data(key.fileobj)
                self._heed_signals()
                self._look_at_processes()
                self._look_at_time()
                self._output.poll()
        finally:
            for process in self._processes:
                process.kill()
            self._hang_up()
            self.outcome.ended_s = time.monotonic()
        return self.outcome

    # ------------------------------------------------------------------ what arrives

    def _accept(self, listening: socket.socket) -> None:
        connected, _ = listening.accept()
        connected.setblocking(True)
        lines = Lines(connected)
        self._lines[lines] = ()
        self._selector.register(lines, selectors.EVENT_READ, self._receive)

    def _receive(self, lines: Lines) -> bool:
        messages = lines.receive()
        if messages is None:
            self._selector.unregister(lines)
            del self._lines[lines]
            lines.close()
            return False
        for message in messages:
            handler: Callable[[Lines, Mapping[str, Any]], None] = getattr(
                self, f"_on_{message['kind']}"
            )
            handler(lines, message)
        return True

    def _on_hello(self, lines: Lines, message: Mapping[str, Any]) -> None:
        self._lines[lines] = tuple(message["nodes"])
        self._watch.greet(message["nodes"])
        if self._phase is not Phase.RUNNING:
            lines.send("stop")

    def _on_report(self, _: Lines, message: Mapping[str, Any]) -> None:
        name = message["node"]
        if self.outcome.reports.get(name, {}).get("is_final"):
            return  # the thread that reports once per second was one word behind
        self.outcome.reports[name] = message
        self.outcome.report_times_s[name] = time.monotonic()
        self._watch.report(name, message)
        if message.get("probe") == self._probe_number and self._probe_number:
            self._probes[name] = message
            if len(self._probes) == len(self._files):
                self._judge()

    def _on_first_hook(self, _: Lines, message: Mapping[str, Any]) -> None:
        if self.outcome.started_s is None:
            self.outcome.started_s = time.monotonic()

    def _on_shutdown(self, _: Lines, message: Mapping[str, Any]) -> None:
        reason = f": {message['reason']}" if message["reason"] else ""
        self._drain(f"{message['node']} ended the project{reason}", float(message["drain_s"]))

    def _on_failed(self, _: Lines, message: Mapping[str, Any]) -> None:
        first_line = str(message["text"]).splitlines()[0]
        self._fail(f"node '{message['node']}' failed: {first_line}")

    def _on_explanation(self, _: Lines, message: Mapping[str, Any]) -> None:
        for line in message["lines"]:
            self._output.log("WARN", f"{message['node']} {line}")

    # ------------------------------------------------------------------ ending

    def _drain(self, reason: str, drain_s: float) -> None:
        if self._phase is not Phase.RUNNING:
            return
        self._phase = Phase.DRAINING
        self.outcome.ending_s = time.monotonic()
        self.outcome.reason = reason
        self._deadline_s = time.monotonic() + drain_s
        self._output.log("INFO", f"{reason}; letting packets under way arrive")
        self._broadcast("drain")
        self._probe()

    def _fail(self, reason: str) -> None:
        if self._phase in (Phase.RUNNING, Phase.DRAINING):
            self.outcome.exit_code = 1
            self.outcome.reason = reason
            self._stop()
        if self.outcome.exit_code == 1:
            self.outcome.failures.append(reason)

    def _stop(self) -> None:
        self._phase = Phase.STOPPING
        if self.outcome.ending_s is None:
            self.outcome.ending_s = time.monotonic()
        self._deadline_s = time.monotonic() + STOP_S
        greeted = {name for names in self._lines.values() for name in names}
        self._broadcast("stop")
        for process in self._processes:
            if not greeted.intersection(process.names):
                process.kill()  # it has not come as far as anything worth finalising

    def _kill(self) -> None:
        self._phase = Phase.KILLED
        for process in self._processes:
            process.kill()

    def _heed_signals(self) -> None:
        while self._signals:
            number = self._signals.pop(0)
            if self._phase in (Phase.STOPPING, Phase.KILLED):
                self._kill()
                continue
            name = "Ctrl+C" if number == 2 else "SIGTERM"
            self.outcome.exit_code = 128 + number
            self.outcome.reason = f"ended by {name}"
            self._output.log("INFO", f"{name}: stopping (once more kills at once)")
            self._stop()

    def _look_at_processes(self) -> None:
        for process in tuple(self._processes):
            how = process.poll()
            if how is None:
                continue
            self._processes.remove(process)
            self._read_last_words(process)
            if self._phase in (Phase.RUNNING, Phase.DRAINING):
                names = " and ".join(f"'{name}'" for name in process.names)
                self._fail(f"node {names} ended unexpectedly: {how}")

    def _read_last_words(self, process: RunningNode) -> None:
        for lines, names in tuple(self._lines.items()):
            if set(names) & set(process.names):
                while self._receive(lines):
                    pass

    # ------------------------------------------------------------------ time

    def _look_at_time(self) -> None:
        now_s = time.monotonic()
        if self._phase is Phase.STOPPING and now_s >= self._deadline_s:
            for process in self._processes:
                names = ", ".join(process.names)
                self._output.log("WARN", f"{names}: not ended after {STOP_S:g} s, killed")
            self._kill()
        elif self._phase is Phase.DRAINING:
            if now_s >= self._deadline_s:
                self._output.log("WARN", "not drained in time: packets under way are lost")
                self._stop()
            elif len(self._probes) == len(self._files):
                self._probe()
        elif self._phase is Phase.RUNNING:
            self._look_at_run(now_s)

    def _look_at_run(self, now_s: float) -> None:
        started_s = self.outcome.started_s
        limit_s = self._duration_s
        if limit_s is not None and started_s is not None and now_s - started_s >= limit_s:
            self._drain(f"{limit_s:g} s are over", STOP_S)
            return
        for severity, text in self._watch.remarks(now_s):
            self._output.log(severity, text)
        if self._watch.has_just_stalled(now_s):
            self._broadcast("explain")
        has_rested = self._watch.rested_s(now_s) >= _DEADLOCK_AFTER_S
        is_time = now_s - self._probe_sent_s >= _DEADLOCK_AFTER_S / 2
        if has_rested and is_time and not self._is_partial:
            self._probe()

    # ------------------------------------------------------------------ probes

    def _probe(self) -> None:
        self._probe_number += 1
        self._probe_sent_s = time.monotonic()
        self._probes = {}
        self._broadcast("probe", number=self._probe_number)

    def _judge(self) -> None:
        if any(probe["ledger"] is None for probe in self._probes.values()):
            return
        this_round = counters(self._probes)
        is_stable, self._last_round = this_round == self._last_round, this_round
        if not is_stable:
            return
        if self._phase is Phase.DRAINING and is_drained(self._probes, self._connections):
            self._stop()
        elif self._phase is Phase.RUNNING and is_dead(self._probes, self._connections):
            ring = cycle(waits(self._probes, self._connections))
            why = "; ".join(f"{node} {reason}" for node, reason in ring) or "no hook can run"
            self._fail(
                f"deadlock: nothing can ever run again: {why}. Take the returning input in a"
                " hook of its own without outputs, or make it required with one packet from an"
                " initialise hook, or omit discard_limit on one connection of the loop"
            )

    def _broadcast(self, kind: str, **fields: Any) -> None:
        for lines in tuple(self._lines):
            lines.send(kind, **fields)

    def _hang_up(self) -> None:
        for lines in tuple(self._lines):
            while self._receive(lines):
                pass
        self._selector.close()
        self._listening.close()
