"""Judges from probes of all nodes whether a project is drained, or deadlocked.

A probe is a report that a node makes between two events. Probes of different nodes are not made at
the same instant, so one round of them can miss a packet that is under way; two rounds with the same
counters cannot (F. Mattern, "Algorithms for distributed termination detection", 1987).

:class:`Settling` finds out when nothing moves any more in a run that is paused: the end of a step
of a session. Each node process answers when no event waits in it, and none starts anything unasked.
They answer at different instants, but with counters by connection one round is enough: if something
still moved, then some process was the first to receive a packet after its answer. That was sent
before the answer of its sender, so the counters of this connection would differ (Mattern's channel
counting).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from typing import Any, TypeAlias

from neuros.control import (
    AtRest,
    Message,
    NewestPacket,
    Pause,
    Probe,
    Probed,
    ReceivedCounts,
    SentCounts,
    Settle,
    Settled,
)
from neuros.control.link import ControlLink
from neuros.launcher.channels import Channels
from neuros.launcher.peers import Peers
from neuros.project.model import Connection, NodeFile

DEADLOCK_AFTER_S = 1.0
"""Nothing must have moved for this long before nodes are asked whether anything ever will."""

_DRAINING_PAUSE_S = 0.01
# Two rounds tell a deadlock. Where they told that somebody may wake a node, the answers of the
# next rounds will hardly differ, so these come more and more rarely until something has moved.
_RUNNING_PAUSE_S = DEADLOCK_AFTER_S / 2
_LONGEST_PAUSE_S = 2.0
_BUSY_S = 0.1

Probes = Mapping[str, Probed]
"""The newest probe by node."""

Waits = Mapping[str, Mapping[str, str]]
"""``waits[node]`` maps the nodes that it waits for to the reason."""


class Verdict(Enum):
    """Conclusion from a round of probes."""

    UNDECIDED = "undecided"
    DRAINED = "drained"
    DEAD = "dead"


class Probing:
    """Finds out whether a project is drained or dead.

    Args:
        names: the nodes, all of which have to answer.
        connections: those among them.
        send: sends to all processes.
        peers: who has to agree that the project is drained, where not all nodes are here.
    """

    def __init__(
        self,
        names: Iterable[str],
        connections: Sequence[Connection],
        send: Callable[[Message], object],
        peers: Peers | None = None,
    ) -> None:
        self._names = set(names)
        self._connections = connections
        self._send = send
        self._peers = peers
        self._is_draining = False
        self._number = 0
        self._asked_s = 0.0
        self._pause_s = 0.0
        self._probes: dict[str, Probed] = {}
        self._answers: Probes = {}  # of the last whole round
        self._last_round: tuple[Any, ...] | None = None
        self.verdict = Verdict.UNDECIDED

    def drain(self, without: Iterable[str], now_s: float) -> None:
        """From now on find out when the nodes, ``without`` those that never began, are drained."""
        self._is_draining = True
        self._names.difference_update(without)
        self._last_round = None
        self.verdict = Verdict.UNDECIDED if self._names else Verdict.DRAINED
        self._ask(now_s)

    def take(self, probe: Probed) -> None:
        """Take an answer, perhaps to the last probe."""
        if probe.number == self._number and probe.node in self._names:
            self._probes[probe.node] = probe
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
        ring = cycle(waits(self._probes, self._connections))
        why = "; ".join(f"{node} {reason}" for node, reason in ring) or "no hook can run"
        return (
            f"deadlock: nothing can ever run again: {why}. To break the loop, take the returning"
            " input in a separate hook without outputs; or require it, and send a first packet"
            " from an initialise hook; or leave out discard_limit on one connection of the loop"
        )

    def what_is_left(self, now_s: float) -> list[str]:
        """Why it is not drained: who does not answer, or else where packets are or wait."""
        silent = sorted(self._names - self._probes.keys())
        if silent and now_s - self._asked_s >= _BUSY_S:
            return [f"{name} is busy" for name in silent]
        probes = self._probes if not silent else self._answers
        waiting = [name for name, probe in sorted(probes.items()) if probe.is_startable]
        return [
            *(f"a packet is under way on `{key}`" for key in under_way(probes, self._connections)),
            *(f"{name} has a packet to work on" for name in waiting),
        ]

    def _ask(self, now_s: float) -> None:
        self._number += 1
        self._asked_s = now_s
        self._probes = {}
        self._send(Probe(self._number))

    def _judge(self) -> None:
        probes, connections = self._probes, self._connections
        self._answers = probes
        if self._is_draining:
            this_round: tuple[Any, ...] = reliable_counters(probes, connections)
            is_over, verdict = is_drained(probes, connections), Verdict.DRAINED
        else:
            this_round = counters(probes)
            is_over, verdict = is_dead(probes, connections), Verdict.DEAD
        is_stable, self._last_round = this_round == self._last_round, this_round
        if is_over and is_stable and self._others_agree():
            self.verdict = verdict
        elif self._peers is not None and not (is_over and is_stable):
            self._peers.unsettle()

    def _others_agree(self) -> bool:
        return self._peers is None or self._peers.settle(self._probes)


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


def counters(probes: Probes) -> tuple[Any, ...]:
    """All that happens in a project, counted: it rests if this stays the same."""
    return tuple(
        (
            name,
            tuple(
                (key, c["sent"], c["acknowledged"])
                for key, c in sorted(probe.metrics["outgoing"].items())
            ),
            tuple(
                (key, c["received"], c["acknowledged"])
                for key, c in sorted(probe.metrics["incoming"].items())
            ),
            tuple(
                (key, hook["executions"]) for key, hook in sorted(probe.metrics["hooks"].items())
            ),
        )
        for name, probe in sorted(probes.items())
    )


def reliable_counters(
    probes: Probes, connections: Sequence[Connection]
) -> tuple[tuple[int, ...], ...]:
    """All that happens on reliable connections, counted; packets that may be lost flood on."""
    return tuple(
        (outgoing["sent"], outgoing["acknowledged"], incoming["received"], incoming["acknowledged"])
        for _, outgoing, incoming in _reliable(probes, connections)
    )


def under_way(probes: Probes, connections: Sequence[Connection]) -> list[str]:
    """Reliable connections with a packet or an acknowledgement that has not arrived."""
    return [
        str(connection)
        for connection, outgoing, incoming in _reliable(probes, connections)
        if outgoing["sent"] != incoming["received"]
        or outgoing["acknowledged"] != incoming["acknowledged"]
    ]


def is_drained(probes: Probes, connections: Sequence[Connection]) -> bool:
    """Whether no reliable packet is under way, and none waits that some hook could start on."""
    return not under_way(probes, connections) and not any(
        probe.is_startable for probe in probes.values()
    )


def is_dead(probes: Probes, connections: Sequence[Connection]) -> bool:
    """Whether no node can ever run a hook again."""
    return not under_way(probes, connections) and all(
        probe.is_idle and not probe.is_wakeable for probe in probes.values()
    )


def waits(probes: Probes, connections: Sequence[Connection]) -> dict[str, dict[str, str]]:
    """The nodes that wait for each other, and why."""
    result: dict[str, dict[str, str]] = {name: {} for name in probes}
    for connection in connections:
        key = str(connection)
        sender, receiver = connection.source_node, connection.destination_node
        if sender not in probes or receiver not in probes:
            continue
        state = probes[receiver].metrics["state"]
        is_waiting = state["state"] == "waiting"
        outgoing = probes[sender].metrics["outgoing"][key]
        # A packet to itself stays unread for as long as the node waits for another input: then
        # it is that input that it lacks.
        if outgoing["is_blocked"] and not (sender == receiver and is_waiting):
            outstanding = outgoing["outstanding"]
            result[sender].setdefault(
                receiver, f"is blocked on `{key}` ({outstanding} outstanding)"
            )
        is_cause = is_waiting and state["cause"] == connection.destination_input
        if is_cause and not probes[receiver].metrics["incoming"][key]["unread"]:
            result[receiver][sender] = f"waits for `{connection.destination_input}` from {sender}"
    return result


def cycle(waits: Waits) -> list[tuple[str, str]]:
    """A smallest ring of nodes that wait for each other, as ``(node, why)``; else every wait."""
    rings = [ring for node in sorted(waits) if (ring := _ring_through(node, waits))]
    if not rings:
        return [(node, next(iter(why.values()))) for node, why in sorted(waits.items()) if why]
    ring = min(rings, key=len)
    return [(a, waits[a][b]) for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)]


def _ring_through(start: str, waits: Waits) -> list[str]:
    """The shortest way from a node back to itself (breadth first); empty if there is none."""
    paths = [[start]]
    seen: set[str] = set()
    while paths:
        longer = []
        for path in paths:
            for node in sorted(waits.get(path[-1], ())):
                if node == start:
                    return path
                if node not in seen:
                    seen.add(node)
                    longer.append([*path, node])
        paths = longer
    return []


def _reliable(
    probes: Probes, connections: Sequence[Connection]
) -> Iterator[tuple[Connection, SentCounts, ReceivedCounts]]:
    """The counters at both ends of every reliable connection between nodes that were probed."""
    for connection in connections:
        sender = probes.get(connection.source_node)
        receiver = probes.get(connection.destination_node)
        if connection.is_reliable and sender and receiver:
            key = str(connection)
            yield (
                connection,
                sender.metrics["outgoing"][key],
                receiver.metrics["incoming"][key],
            )


_FIRST_LOOK_S = 0.0005
_RAREST_LOOK_S = 0.02
_LOST_AFTER_S = 0.1
"""On a connection that may lose packets, one that has not arrived for so long has been lost."""
_NEVER_S = 3600.0

Counts: TypeAlias = Mapping[str, tuple[int, int]]
"""By connection, packets that have passed, and those acknowledged; -1: none ever are."""


class Settling:
    """Answers ``settle`` of a session: once all nodes have begun, and nothing moves.

    Args:
        names: the nodes, all of which have to answer.
        clock: monotonic, seconds.
    """

    def __init__(
        self,
        names: Iterable[str],
        channels: Channels,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._names = set(names)
        self._channels = channels
        self._clock = clock
        self._asker: ControlLink | None = None
        self._asked = Settle(0, {})
        self._round = 0
        self._pause_s = 0.0
        self._due_s: float | None = None
        self._answers: dict[tuple[str, ...], AtRest] = {}
        self._packets: dict[str, NewestPacket] = {}
        self._last: tuple[Counts, Counts] | None = None
        self._last_s = 0.0

    @property
    def wait_s(self) -> float:
        """Seconds until :meth:`look` has something to do."""
        return _NEVER_S if self._due_s is None else max(0.0, self._due_s - self._clock())

    def ask(self, asker: ControlLink, message: Settle) -> None:
        """Find out from now on, and answer this one; what was asked before is answered no more."""
        self._asker, self._asked = asker, message
        self._packets.clear()
        self._pause_s, self._last = 0.0, None
        self._begin_round()

    def take(self, answer: AtRest) -> None:
        """Take an answer of a process, perhaps to the last round."""
        if answer.number != self._round or self._asker is None:
            return
        self._answers[answer.nodes] = answer
        self._packets.update(answer.packets)
        if {name for names in self._answers for name in names} == self._names:
            self._judge(self._asker)

    def look(self) -> None:
        """Ask again where it is time."""
        if self._due_s is not None and self._clock() >= self._due_s:
            self._begin_round()

    def _begin_round(self) -> None:
        self._due_s = None
        if not self._channels.greeted >= self._names:
            self._ask_later()
            return
        self._round += 1
        self._answers.clear()
        known = {name: packet.number for name, packet in self._packets.items()}
        self._channels.send(Settle(self._round, {**self._asked.known, **known}))

    def _ask_later(self) -> None:
        self._pause_s = min(max(2 * self._pause_s, _FIRST_LOOK_S), _RAREST_LOOK_S)
        self._due_s = self._clock() + self._pause_s

    def _judge(self, asker: ControlLink) -> None:
        answers = self._answers.values()
        if not all(answer.has_begun for answer in answers) or self._is_under_way():
            self._ask_later()
        else:
            self._answer(asker)

    def _is_under_way(self) -> bool:
        """Whether a packet or an acknowledgement is on its way, and not lost."""
        sent = _joined(answer.sent for answer in self._answers.values())
        received = _joined(answer.received for answer in self._answers.values())
        different = [key for key in sent if sent[key] != received[key]]
        if any(sent[key][1] >= 0 for key in different):
            return True
        if (sent, received) != self._last:
            self._last, self._last_s = (sent, received), self._clock()
        return bool(different) and self._clock() - self._last_s < _LOST_AFTER_S

    def _answer(self, asker: ControlLink) -> None:
        self._asker = None
        self._channels.send(Pause())  # takes back what hooks could not use of a step
        times = {n: t for answer in self._answers.values() for n, t in answer.sim_times.items()}
        self._channels.send_to(asker, Settled(self._asked.number, times, dict(self._packets)))


def _joined(parts: Iterable[Counts]) -> Counts:
    return {key: counts for part in parts for key, counts in part.items()}
