"""Rounds of probes: asks all nodes at once, again and again, and judges their answers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum
from typing import Any

from neuros.launch import quiescence
from neuros.launch.sides import Sides
from neuros.project.model import Connection, NodeFile

DEADLOCK_AFTER_S = 1.0
"""Nothing must have moved for this long before nodes are asked whether anything ever will."""

_DRAINING_PAUSE_S = 0.01
# Two rounds tell a deadlock. Where they told that somebody may wake a node, the answers of the
# next rounds will hardly differ, so these come more and more rarely until something has moved.
_RUNNING_PAUSE_S = DEADLOCK_AFTER_S / 2
_LONGEST_PAUSE_S = 2.0
_BUSY_S = 0.1


class Verdict(Enum):
    """What the answers say."""

    UNDECIDED = "undecided"
    DRAINED = "drained"
    DEAD = "dead"


class Probing:
    """Finds out whether a project is drained or dead.

    Args:
        names: the nodes, all of which have to answer.
        connections: those among them.
        send: sends to all processes, ``send("probe", number=3)``.
        sides: who has to agree that the project is drained, where not all nodes are here.
    """

    def __init__(
        self,
        names: Iterable[str],
        connections: Sequence[Connection],
        send: Callable[..., object],
        sides: Sides | None = None,
    ) -> None:
        self._names = set(names)
        self._connections = connections
        self._send = send
        self._sides = sides
        self._is_draining = False
        self._number = 0
        self._asked_s = 0.0
        self._pause_s = 0.0
        self._probes: dict[str, Mapping[str, Any]] = {}
        self._answers: Mapping[str, Mapping[str, Any]] = {}  # of the last whole round
        self._last_round: tuple[Any, ...] | None = None
        self.verdict = Verdict.UNDECIDED

    def drain(self, without: Iterable[str], now_s: float) -> None:
        """From now on find out when the nodes, ``without`` those that never began, are drained."""
        self._is_draining = True
        self._names.difference_update(without)
        self._last_round = None
        self.verdict = Verdict.UNDECIDED if self._names else Verdict.DRAINED
        self._ask(now_s)

    def take(self, name: str, report: Mapping[str, Any]) -> None:
        """Take a report; it may be the answer to the last probe."""
        if self._number and report.get("probe") == self._number and name in self._names:
            self._probes[name] = report
            if len(self._probes) == len(self._names):
                self._judge()

    def look(self, now_s: float, rested_s: float) -> Verdict:
        """Ask again where it is time; ``rested_s`` is for how long nothing has moved."""
        pause_s = now_s - self._asked_s
        if self._is_draining:
            has_answers = len(self._probes) == len(self._names)
            if has_answers and pause_s >= _DRAINING_PAUSE_S and self.verdict is Verdict.UNDECIDED:
                self._ask(now_s)
        elif rested_s < DEADLOCK_AFTER_S:
            self._pause_s = 0.0
        elif pause_s >= self._pause_s:
            self._pause_s = min(max(2 * self._pause_s, _RUNNING_PAUSE_S), _LONGEST_PAUSE_S)
            self._ask(now_s)
        return self.verdict

    def why_dead(self) -> str:
        """The deadlock in one sentence, with its cycle and its cures."""
        ring = quiescence.cycle(quiescence.waits(self._probes, self._connections))
        why = "; ".join(f"{node} {reason}" for node, reason in ring) or "no hook can run"
        return (
            f"deadlock: nothing can ever run again: {why}. Take the returning input in a hook of"
            " its own without outputs, or make it required with one packet from an initialise"
            " hook, or omit discard_limit on one connection of the loop"
        )

    def what_is_left(self, now_s: float) -> list[str]:
        """Why it is not drained: who does not answer, or else where packets are or wait."""
        silent = sorted(self._names - self._probes.keys())
        if silent and now_s - self._asked_s >= _BUSY_S:
            return [f"{name} is busy" for name in silent]
        probes = self._probes if not silent else self._answers
        under_way = quiescence.under_way(probes, self._connections)
        waiting = [name for name, probe in sorted(probes.items()) if probe["is_startable"]]
        return [
            *(f"a packet is under way on `{key}`" for key in under_way),
            *(f"{name} has a packet to work on" for name in waiting),
        ]

    def _ask(self, now_s: float) -> None:
        self._number += 1
        self._asked_s = now_s
        self._probes = {}
        self._send("probe", number=self._number)

    def _judge(self) -> None:
        probes, connections = self._probes, self._connections
        self._answers = probes
        if any(probe["metrics"] is None for probe in probes.values()):
            return
        if self._is_draining:
            this_round: tuple[Any, ...] = quiescence.reliable_counters(probes, connections)
            is_over, verdict = quiescence.is_drained(probes, connections), Verdict.DRAINED
        else:
            this_round = quiescence.counters(probes)
            is_over, verdict = quiescence.is_dead(probes, connections), Verdict.DEAD
        is_stable, self._last_round = this_round == self._last_round, this_round
        if is_over and is_stable and self._others_agree():
            self.verdict = verdict
        elif self._sides is not None and not (is_over and is_stable):
            self._sides.unsettle()

    def _others_agree(self) -> bool:
        return self._sides is None or self._sides.settle(self._probes)


def connections_among(files: Sequence[NodeFile]) -> list[Connection]:
    """Connections with both ends in these nodes, each once, in the order of the project."""
    names = {file.node.name for file in files}
    found = {
        connection
        for file in files
        for connection in file.connections
        if {connection.source_node, connection.destination_node} <= names
    }
    return sorted(found, key=lambda connection: connection.index)
