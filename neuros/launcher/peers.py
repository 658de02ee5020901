"""Launchers that run parts of one project: their states, and the common end.

The launchers are *peers*, and meet through their nodes alone: each publishes its
:class:`PeerState` through its nodes, and receives those of its peers. So peers can start in any
order; each knows for which it still waits; and the end of one is the end of all.
"""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import IntEnum
from typing import Any, NamedTuple

from neuros.control import NodeProbe, Report
from neuros.control.link import read_as
from neuros.errors import ControlError
from neuros.project.model import Connection, NodeFile

Ends = Mapping[str, "tuple[int, int]"]
"""By connection, packets that have passed at one of its ends, and those acknowledged."""

Counters = Mapping[str, Mapping[str, Mapping[str, Mapping[str, Any]]]]
"""``counters[node]["outgoing" or "incoming"][connection]``: counters, as in a node's metrics."""

RUNNING, DRAINING, DRAINED, STOPPING, OVER = "running", "draining", "drained", "stopping", "over"
_BEGUN = (RUNNING, DRAINING, DRAINED)
_FIRST_REMARK_S = 5.0
_NEXT_REMARK_S = 10.0
# A node that is gone may have said why a moment before, on a longer way.
_GRACE_S = 0.3
# How long a launcher that has come to its end waits for what a peer has counted.
_PATIENCE_S = 2.0


class Stage(IntEnum):
    """How far the start of a launcher's nodes has come."""

    LOADING = 0
    LOADED = 1
    READY = 2


@dataclass(frozen=True)
class PeerState:
    """State that one launcher publishes to its peers: all of it, so that a missed one is no loss.

    Attributes:
        run: which run it is.
        machine: its name.
        number: a later state has a higher one.
        stage: a :class:`Stage`, of the start there.
        phase: of the run there.
        exit_code, reason: how it ends, from when it is to end on.
        origin: the machine on which the cause of that lies.
        drain_s: for how long it drains at most.
        sent, received: of the connections between peers, when drained.
        counters: of these, when over.
    """

    run: str
    machine: str
    number: int = 0
    stage: int = Stage.LOADING
    phase: str = RUNNING
    exit_code: int = 0
    reason: str = ""
    origin: str = ""
    drain_s: float = 0.0
    counters: Counters = field(default_factory=dict)
    sent: Ends = field(default_factory=dict)
    received: Ends = field(default_factory=dict)

    def to_text(self) -> str:
        return json.dumps(asdict(self))

    @property
    def has_just_begun(self) -> bool:
        """Whether a peer that starts now can still take part."""
        return self.phase in _BEGUN

    @property
    def is_ending(self) -> bool:
        return self.phase != RUNNING


def state_from(text: str) -> PeerState | None:
    """The inverse of :meth:`PeerState.to_text`; ``None`` for anything else."""
    try:
        return read_as(PeerState, json.loads(text))
    except (ControlError, ValueError, RecursionError):
        return None


def counters_of(reports: Mapping[str, Report], crossing: Sequence[Connection]) -> Counters:
    """The counters of connections to peers, from the reports of the nodes here."""
    keys = {str(connection) for connection in crossing}
    return {
        name: {
            "outgoing": {key: {**c} for key, c in metrics["outgoing"].items() if key in keys},
            "incoming": {key: {**c} for key, c in metrics["incoming"].items() if key in keys},
        }
        for name, report in reports.items()
        if (metrics := report.metrics) is not None
    }


class EndElsewhere(NamedTuple):
    """The end of the project elsewhere: its exit code, its reason, and for how long it drains."""

    exit_code: int
    reason: str
    drain_s: float


class Peers:
    """The peers of this launcher: their states, and its own.

    Args:
        run: marks this run.
        elsewhere: the nodes of the project that are not started here; none: there are no peers.
        files: the nodes that are.
        hint: what to add where nodes elsewhere are waited for.
        timeout_s: how long they are waited for; ``None``: for ever.
    """

    def __init__(
        self,
        run: str,
        elsewhere: Sequence[str],
        files: Sequence[NodeFile],
        hint: str = "",
        timeout_s: float | None = None,
    ) -> None:
        self._elsewhere = elsewhere
        self._hint = hint
        self._timeout_s = timeout_s
        here = {file.node.name for file in files}
        self._crossing = sorted(
            {c for file in files for c in file.connections if not _ends(c) <= here},
            key=lambda connection: connection.index,
        )
        self._missing = set(elsewhere)
        self._found: list[str] = []
        self._send: Callable[[str], object] = lambda _: None
        self._own = PeerState(run, socket.gethostname())
        self._others: dict[str, PeerState] = {}
        self._run_of: dict[str, str] = {}
        self._gone_s: dict[str, float] = {}
        self._next_remark_s: float | None = None
        self._give_up_s: float | None = None
        self._over_s: float | None = None

    # ------------------------------------------------------------------ own state

    def publish_through(self, send: Callable[[str], object]) -> None:
        """Have nodes publish the states of this launcher by ``send(text)``."""
        self._send = send

    @property
    def exist(self) -> bool:
        return bool(self._elsewhere)

    @property
    def own_state(self) -> str:
        """The newest state of this launcher, for nodes that have just come."""
        return self._own.to_text()

    def reach(self, stage: Stage) -> None:
        """The nodes here have reached a stage of the start."""
        if self._own.stage < stage:
            self._publish(stage=stage)

    def have_reached(self, stage: Stage) -> bool:
        """Whether every node elsewhere has reached this stage."""
        return not self._behind(stage)

    def drain(self, reason: str, drain_s: float) -> None:
        self._publish(phase=DRAINING, drain_s=drain_s, **self._because(reason, 0))

    def agree_on_end(self, probes: Mapping[str, NodeProbe]) -> bool:
        """The run here is drained by itself; returns whether peers agree, and nothing is under way.

        Others count it as drained only while the counters of both ends are equal. A packet under
        way shows in them (Mattern's counters, see :mod:`neuros.launcher.quiescence`).
        """
        ends = {
            "sent": self._between_peers(probe.sent for probe in probes.values()),
            "received": self._between_peers(probe.received for probe in probes.values()),
        }
        own = {"phase": self._own.phase, "sent": self._own.sent, "received": self._own.received}
        if own != {"phase": DRAINED, **ends}:
            self._publish(phase=DRAINED, **ends)
        return all(self._agrees(each) for each in self._others.values() if each.has_just_begun)

    def go_on(self) -> None:
        """A node here still has something to do."""
        if self._own.phase == DRAINED:
            self._publish(phase=DRAINING)

    def stop(self, exit_code: int, reason: str) -> None:
        self._publish(phase=STOPPING, **self._because(reason, exit_code))

    def finish(self, reports: Mapping[str, Report], now_s: float) -> bool:
        """No node here runs hooks any more; returns whether they may go."""
        if self._over_s is None:
            self._over_s = now_s
            self._publish(phase=OVER, counters=counters_of(reports, self._crossing))
        return not self._unfinished() or now_s - self._over_s >= _PATIENCE_S

    # ------------------------------------------------------------------ states of others

    def receive(self, node: str, text: str | None, now_s: float) -> None:
        """A node elsewhere has published a state, or is gone (``None``)."""
        if text is None:
            if node in self._run_of:
                self._gone_s.setdefault(node, now_s)
            return
        state = state_from(text)
        if state is None or state.run == self._own.run:
            return
        if state.run not in self._others and not state.has_just_begun:
            return  # the rest of a run before this one
        if self._run_of.setdefault(node, state.run) != state.run:
            self._gone_s.setdefault(node, now_s)  # another has taken its place
            return
        if node in self._missing:
            self._missing.remove(node)
            self._found.append(f"{node} ({state.machine})")
        if state.run not in self._others or state.number > self._others[state.run].number:
            self._others[state.run] = state

    def end(self, now_s: float) -> EndElsewhere | None:
        for node, gone_s in self._gone_s.items():
            state = self._others[self._run_of[node]]
            if not state.is_ending and now_s - gone_s >= _GRACE_S:
                machine = state.machine
                return EndElsewhere(
                    1,
                    f"node '{node}' on {machine} is gone: it was killed, or {machine} or the"
                    " network to it is down",
                    0.0,
                )
        ending = [state for state in self._others.values() if state.is_ending]
        if not ending:
            return None
        worst = max(ending, key=lambda state: state.exit_code)
        reason = f"the project ended elsewhere ({worst.origin}): {worst.reason}"
        return EndElsewhere(worst.exit_code, reason, worst.drain_s)

    def counters(self) -> Mapping[str, Mapping[str, Any]]:
        """Counters of nodes elsewhere on connections to here, of peers that are over."""
        over = [state for state in self._others.values() if state.phase == OVER]
        return {node: metrics for state in over for node, metrics in state.counters.items()}

    def remarks(self, now_s: float) -> Iterator[tuple[str, str]]:
        """Remarks for the user now, as ``(severity, text)``."""
        if self._found:
            yield "INFO", f"found elsewhere: {', '.join(self._found)}"
            self._found.clear()
        if self._next_remark_s is None:
            self._next_remark_s = now_s + _FIRST_REMARK_S
        if self._missing and now_s >= self._next_remark_s:
            self._next_remark_s = now_s + _NEXT_REMARK_S
            yield "INFO", f"still waiting for nodes elsewhere: {self._names()}{self._hint}"
        elif now_s >= self._next_remark_s and (behind := self._behind(self._own.stage)):
            self._next_remark_s = now_s + _NEXT_REMARK_S
            yield "INFO", f"nodes elsewhere are still starting: {', '.join(behind)}"

    def overdue(self, now_s: float) -> str:
        """Which nodes elsewhere were waited for too long, in a sentence; empty: none."""
        if self._give_up_s is None:
            self._give_up_s = now_s + (math.inf if self._timeout_s is None else self._timeout_s)
        if not self._missing or now_s < self._give_up_s:
            return ""
        return (
            f"not found elsewhere within {self._timeout_s:g} s: {self._names()}{self._hint}: has it"
            " failed there, or does no network lead to it?"
        )

    # ------------------------------------------------------------------ inside

    def _behind(self, stage: int) -> list[str]:
        """The nodes elsewhere that have not reached this stage."""
        found = {name: self._others[run].stage for name, run in self._run_of.items()}
        return [name for name in self._elsewhere if found.get(name, -1) < stage]

    def _names(self) -> str:
        return ", ".join(sorted(self._missing))

    def _publish(self, **changes: Any) -> None:
        if self._elsewhere:
            self._own = replace(self._own, number=self._own.number + 1, **changes)
            self._send(self.own_state)

    def _because(self, reason: str, exit_code: int) -> dict[str, Any]:
        """The cause of the end; the first one stays, and where it is known from elsewhere."""
        for state in self._others.values():
            if state.is_ending and state.reason and reason.endswith(state.reason):
                return {"reason": state.reason, "origin": state.origin, "exit_code": exit_code}
        return {"reason": reason, "origin": self._own.machine, "exit_code": exit_code}

    def _unfinished(self) -> bool:
        """Whether a peer that is there has not published its final counters."""
        gone = {self._run_of[node] for node in self._gone_s}
        return any(s.phase != OVER and s.run not in gone for s in self._others.values())

    def _between_peers(self, ends: Iterable[Ends]) -> Ends:
        keys = {str(connection) for connection in self._crossing}
        return {key: counts for each in ends for key, counts in each.items() if key in keys}

    def _agrees(self, other: PeerState) -> bool:
        sent = {**self._own.sent, **other.sent}
        received = {**self._own.received, **other.received}
        theirs = other.sent.keys() | other.received.keys()
        return other.phase == DRAINED and all(
            sent.get(key) == received.get(key)
            for key in theirs.intersection(str(c) for c in self._crossing if c.is_reliable)
        )


def _ends(connection: Connection) -> set[str]:
    return {connection.source_node, connection.destination_node}
