"""Phases of a run, and its outcome."""

from __future__ import annotations

import signal
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise
from typing import Any, Protocol

from neuros.control import Report
from neuros.ports import RunningNode

EXIT_CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 143}
SIGNAL_NAMES = {
    signal.SIGINT: "Ctrl+C",
    signal.SIGTERM: "SIGTERM",
    signal.SIGHUP: "SIGHUP (the terminal was closed)",
}


class SupervisorOutput(Protocol):
    """Output of the supervisor for people; neither call may wait for a reader.

    Records of severity ``DEBUG`` are kept, and not shown.
    ``poll`` shows what nodes have logged since; it returns whether that was anything.
    """

    def log(self, severity: str, text: str) -> None: ...
    def poll(self) -> object: ...


class Phase(Enum):
    """The phases of a run; it runs once every node has initialised."""

    STARTING = "starting"
    RUNNING = "running"
    DRAINING = "draining"
    STOPPING = "stopping"
    KILLED = "killed"


@dataclass
class Outcome:
    """The end of a run, and the last reports of its nodes.

    Attributes:
        exit_code: 0 ended normally, 1 a node failed or deadlock, 4 the engine went away or what
            should have been recorded could not be, 5 a budget was broken, 7 the program that had
            started it failed, 130 and 143 by signal.
        reason: one line for the user.
        reports: the last report of every node that made one.
        report_times_s: when that was, on the monotonic clock.
        timelines: by node, points of simulated against wall time; each report brings further ones.
        elsewhere: what nodes that other launchers started counted on connections to here.
        started_s: time 0 of the run, when every node was ready; ``None`` if that never came.
        ending_s: when the end was asked for first: what comes after is draining and finalising. A
            run that is stopped while it stands still has ended when that pause began.
        paused_s: how long it has stood still since time 0.
        is_paused: whether it stands still now.
        stacks: where nodes that were killed stood in their plugins, by name.
        has_drained: whether packets in flight were waited for. After a signal or a failure they are
            not: a node that stops later may send to one that has stopped.
        late_drain: why it was not drained in time, empty if it was.
        ended_s: when all processes had ended.
        is_signalled: whether the user has asked for the end by a signal, be it after another cause.
        faults: what could not be recorded, though the run went on.
        failures: one line for each, in the order in which they became known.
    """

    exit_code: int = 0
    reason: str = ""
    reports: dict[str, Report] = field(default_factory=dict)
    report_times_s: dict[str, float] = field(default_factory=dict)
    timelines: dict[str, list[Sequence[float]]] = field(default_factory=dict)
    elsewhere: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    started_s: float | None = None
    ending_s: float | None = None
    stacks: dict[str, str] = field(default_factory=dict)
    has_drained: bool = False
    late_drain: str = ""
    ended_s: float = 0.0
    failures: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    is_signalled: bool = False
    paused_s: float = 0.0
    is_paused: bool = False

    @property
    def virtual_s(self) -> float | None:
        """Virtual time, which each node has counted; ``None`` in real time."""
        times = [r.virtual_s for r in self.reports.values() if r.virtual_s is not None]
        return max(times, default=None)

    @property
    def _end_s(self) -> float | None:
        """When the end was asked for, on the clock of the run."""
        return self.ending_s if self.virtual_s is None else self.virtual_s

    @property
    def running_s(self) -> float | None:
        """Time in which all nodes ran: without initialisation, pauses, draining and the end.

        It counts from when every node had initialised, or, if that was not before the end, from
        when the node that owns simulated time had. Virtual time includes draining.
        """
        ending_s = self._end_s
        since = {
            name: report.running_since_s
            for name, report in self.reports.items()
            if report.running_since_s is not None
        }
        if ending_s is None:
            return None
        owners = [since[name] for name in since if self.reports[name].sim_time is not None]
        start_s = max(since.values(), default=ending_s)
        if start_s >= ending_s or len(since) < len(self.reports):
            start_s = max(owners, default=ending_s)
        return max(0.0, ending_s - start_s)

    @property
    def real_time_factor(self) -> float | None:
        """Simulated seconds per second of :attr:`running_s`.

        What a simulator did while other nodes were still initialising does not count.
        """
        times = {
            name: report.sim_time
            for name, report in self.reports.items()
            if report.sim_time is not None
        }
        running_s, ending_s = self.running_s, self._end_s
        if not times or not running_s or ending_s is None:
            return None
        owner = max(times, key=times.__getitem__)
        # Running time leaves pauses out, points of a timeline do not.
        paused_s = self.paused_s if self.virtual_s is None else 0.0
        start_s, end = ending_s - running_s - paused_s, (times[owner], ending_s)
        return _advance(self.timelines.get(owner, ()), start_s, end) / running_s

    def add(self, report: Report, now_s: float) -> None:
        """Keep a report, unless the node has made its final one."""
        name = report.node
        if not self.has_final_report(name):
            self.reports[name] = report
            if report.fault and report.fault not in self.faults:
                self.faults.append(report.fault)
            self.timelines.setdefault(name, []).extend(report.timeline)
            self.report_times_s[name] = now_s

    def begin_to_end(self, now_s: float) -> None:
        """The end has been asked for; the first time counts."""
        if self.ending_s is None:
            self.ending_s = now_s

    def has_final_report(self, name: str) -> bool:
        """Whether a node has come to its end."""
        return name in self.reports and self.reports[name].is_final

    def end_by_force(self, exit_code: int, name: str) -> None:
        """The user has had killed what was left of a run, by a signal of this name."""
        if self.exit_code == 0:
            self.exit_code = exit_code
            self.reason = f"killed by {name} before its nodes had ended: {self.reason}"

    def fail(self, reason: str, exit_code: int = 1) -> None:
        """Note a failure; the first one decides, unless the user had ended the run before."""
        self.failures.append(reason)
        if self.exit_code == 0:
            self.exit_code, self.reason = exit_code, reason


def _advance(
    timeline: Sequence[Sequence[float]], start_s: float, end: tuple[float, float]
) -> float:
    """The simulated seconds since a wall time; a reset takes none of them back."""
    after = bisect_right(timeline, start_s, key=lambda point: point[1])
    points = [(_simulated(timeline, start_s), start_s), *timeline[after:], end]
    return sum(max(0.0, later[0] - earlier[0]) for earlier, later in pairwise(points))


def _simulated(timeline: Sequence[Sequence[float]], wall_s: float) -> float:
    """The simulated time at a wall time, between two points linearly; 0 before the first one."""
    after = bisect_right(timeline, wall_s, key=lambda point: point[1])
    if after == 0:
        return 0.0
    (sim_s, since_s), following = timeline[after - 1], timeline[after:]
    if not following or following[0][0] < sim_s:
        return float(sim_s)
    next_sim_s, next_s = following[0]
    return float(sim_s + (next_sim_s - sim_s) * (wall_s - since_s) / (next_s - since_s))


def names_of(process: RunningNode) -> str:
    return " and ".join(f"'{name}'" for name in process.names)


def nodes_of(process: RunningNode) -> str:
    """Its nodes with the noun, as in "nodes 'a' and 'b'"."""
    return f"node{'' if len(process.names) == 1 else 's'} {names_of(process)}"
