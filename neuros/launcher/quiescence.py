"""Judges from probes of all nodes whether a run is drained, deadlocked, or at the end of a step.

A probe tells where a node stands between two events. Probes of different nodes are not made at the
same instant, so one round of them can miss a packet that is under way; two rounds with the same
counters cannot (F. Mattern, "Algorithms for distributed termination detection", 1987). One round is
enough where each process answers only once no event waits in it, and the run is paused: if
something still moved, then some process was the first to receive a packet after its answer. That
was sent before the answer of its sender, so the counters of this connection would differ.

A loop in which every hook waits for the one before it never comes to rest by itself, so a drained
end has to stop it after one more round. Which hooks these are follows from the declarations of
plugins: :func:`last_round`. Of a node that had to be killed, they tell which finalise hooks did not
run.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from typing import Any, TypeVar

import neuros.control as control
from neuros.hooks import HookKind, InputSpec
from neuros.launcher.peers import Peers
from neuros.project.model import Connection, NodeFile

DEADLOCK_AFTER_S = 1.0
"""Nothing must have moved for this long before nodes are asked whether anything ever will."""

_BUSY_S = 0.1
_LOST_AFTER_S = 0.1
"""On a connection that may lose packets, one that has not arrived for so long has been lost."""

_T = TypeVar("_T")

Probes = Mapping[str, control.NodeProbe]
"""The newest probe by node."""

Waits = Mapping[str, Mapping[str, str]]
"""``waits[node]`` maps the nodes that it waits for to the reason."""


class Verdict(Enum):
    """Conclusion from the rounds of probes."""

    UNDECIDED = "undecided"
    DRAINED = "drained"
    DEAD = "dead"
    AT_REST = "at rest"


# Seconds between the first two rounds, and at most: the pause doubles. Two rounds tell a deadlock;
# where they told that somebody may wake a node, the answers of the next ones will hardly differ.
_PAUSES_S = {
    Verdict.DRAINED: (0.01, 0.01),
    Verdict.DEAD: (DEADLOCK_AFTER_S / 2, 2.0),
    Verdict.AT_REST: (0.0005, 0.02),
}


class Probing:
    """Finds out whether a run is dead, drained, or at the end of a step, whichever is asked for.

    All times are seconds on one monotonic clock.

    Args:
        names: the nodes, all of which have to answer.
        connections: those among them.
        send: sends to all processes.
        peers: who has to agree that the project is drained, where not all nodes are here.
        are_there: whether the processes of all nodes have connected.

    Attributes:
        verdict: what was found, until something else is asked for.
        due_s: when :meth:`check` has something to do in a run that drains or stands still.
    """

    def __init__(
        self,
        names: Iterable[str],
        connections: Sequence[Connection],
        send: Callable[[control.Message], object],
        peers: Peers | None = None,
        are_there: Callable[[], bool] = lambda: True,
    ) -> None:
        self._names = set(names)
        self._connections = connections
        self._send = send
        self._peers = peers
        self._are_there = are_there
        self._goal = Verdict.DEAD
        self._number = 0
        self._asked_s = 0.0
        self._next_s = 0.0  # infinite while answers are awaited
        self._pause_s = 0.0
        self._probes: dict[str, control.NodeProbe] = {}
        self._answers: Probes = {}  # of the last whole round
        self._last_round: tuple[Any, ...] | None = None
        self._same_since_s = 0.0
        self._step = control.Advance(0, 0, {})
        self._packets: dict[str, tuple[int, list[bytes]]] = {}
        self.verdict = Verdict.UNDECIDED

    @property
    def due_s(self) -> float:
        return math.inf if self._goal is Verdict.DEAD else self._next_s

    def drain(self, without: Iterable[str], now_s: float) -> None:
        """From now on find out when the nodes, ``without`` those that never began, are drained."""
        self._names.difference_update(without)
        self._seek(Verdict.DRAINED, now_s)
        if not self._names:
            self.verdict = Verdict.DRAINED

    def await_rest(self, step: control.Advance, now_s: float) -> None:
        """Find out when a step is over; what was asked before is answered no more."""
        if self._goal is not Verdict.DRAINED:
            self._step = step
            self._packets = {}
            self._seek(Verdict.AT_REST, now_s)

    @property
    def virtual_ns(self) -> int | None:
        """The latest time of a node in the last whole round, ``None`` in real time."""
        times = (probe.virtual_ns for probe in self._answers.values())
        return max((each for each in times if each is not None), default=None)

    def end_rest(self) -> control.AtRest:
        """The answer to the session, once it is at rest or waits for that no more."""
        nodes = self._answers.items()
        times = {name: probe.sim_time for name, probe in nodes if probe.sim_time is not None}
        if self._goal is Verdict.AT_REST:
            self._goal, self._pause_s, self._last_round = Verdict.DEAD, 0.0, None
            self.verdict = Verdict.UNDECIDED
        return control.AtRest(self._step.number, times, self._packets)

    def add(self, probed: control.Probed, now_s: float) -> None:
        """An answer of a process has arrived, perhaps to the last round."""
        if probed.number != self._number:
            return
        for output, (number, contents) in probed.packets.items():
            _, before = self._packets.get(output, (0, []))
            self._packets[output] = number, before + contents
        self._probes |= {n: each for n, each in probed.nodes.items() if n in self._names}
        if len(self._probes) == len(self._names) and self._next_s == math.inf:
            self._judge(now_s)
            self._wait(now_s)

    def check(self, now_s: float, rested_s: float) -> Verdict:
        """Ask again where it is time; ``rested_s`` is for how long nothing has moved."""
        if self._goal is Verdict.DEAD and rested_s < DEADLOCK_AFTER_S:
            self._pause_s, self._next_s = 0.0, now_s
        elif self.verdict is Verdict.UNDECIDED and now_s >= self._next_s:
            self._ask(now_s)
        return self.verdict

    def why_dead(self) -> str:
        """The deadlock in one sentence, with its cycle, or what it lacks, and its cures."""
        found = waits(self._probes, self._connections)
        said = "; ".join(f"{node} {reason}" for node, reason in cycle(found)) or "no hook can run"
        others = {other for why in found.values() for other in why}
        if not others:
            cures = "If the work is done, let a hook call node.shutdown"
        elif not any(_ring_through(node, _waited_for(found)) for node in found):
            ends = sorted(others - {node for node, why in found.items() if why})
            cures = (
                f"No hook of {' or '.join(ends)} is left to run: let one send or take what is"
                " waited for; or leave out discard_limit where a sender is blocked; or end the run"
                " with node.shutdown"
            )
        else:
            cures = (
                "To break the loop, take the returning input in a separate hook without outputs; or"
                " require it, and send a first packet from an initialise hook; or leave out"
                " discard_limit on one connection of the loop"
            )
        return f"deadlock: nothing can ever run again: {said}. {cures}"

    def what_is_left(self, now_s: float) -> list[str]:
        """Why it is not drained: who does not answer, or else where packets are or wait."""
        silent = sorted(self._names - self._probes.keys())
        if silent and now_s - self._asked_s >= _BUSY_S:
            return [f"{name} does not answer" for name in silent]
        probes = self._probes if not silent else self._answers
        waiting = [name for name, probe in sorted(probes.items()) if probe.is_startable]
        return [
            *(f"a packet is under way on `{key}`" for key in under_way(probes, self._connections)),
            *(f"{name} has a packet to work on" for name in waiting),
        ]

    def _seek(self, goal: Verdict, now_s: float) -> None:
        self._goal = goal
        self._pause_s, self._last_round = 0.0, None
        self.verdict = Verdict.UNDECIDED
        self._ask(now_s)

    def _ask(self, now_s: float) -> None:
        """Begin a round; a step that is asked for early waits until all nodes are there."""
        is_step = self._goal is Verdict.AT_REST
        if is_step and not self._are_there():
            self._wait(now_s)
            return
        self._number += 1
        self._asked_s, self._next_s = now_s, math.inf
        self._probes = {}
        newest = {output: number for output, (number, _) in self._packets.items()}
        known = {**self._step.known, **newest} if is_step else {}
        self._send(control.Probe(self._number, once_idle=is_step, known=known))

    def _wait(self, now_s: float) -> None:
        first_s, longest_s = _PAUSES_S[self._goal]
        self._pause_s = min(max(2 * self._pause_s, first_s), longest_s)
        self._next_s = now_s + self._pause_s

    def _judge(self, now_s: float) -> None:
        goal, probes, connections = self._goal, self._probes, self._connections
        self._answers = probes
        is_drain = goal is Verdict.DRAINED
        this_round = reliable_counters(probes, connections) if is_drain else counters(probes)
        is_stable = this_round == self._last_round
        if not is_stable:
            self._last_round, self._same_since_s = this_round, now_s
        if goal is Verdict.AT_REST:
            if is_at_rest(probes, connections, now_s - self._same_since_s):
                self.verdict = goal
            return
        is_over = is_stable and (is_drained if is_drain else is_dead)(probes, connections)
        if is_over and (self._peers is None or self._peers.agree_on_end(probes)):
            self.verdict = goal
        elif self._peers is not None and not is_over:
            self._peers.go_on()


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
    return tuple((n, p.executions, p.sent, p.received) for n, p in sorted(probes.items()))


def reliable_counters(probes: Probes, connections: Sequence[Connection]) -> tuple[Any, ...]:
    """All that happens on reliable connections, counted; packets that may be lost flood on."""
    return tuple(
        (sent, received)
        for connection, sent, received in _ends(probes, connections)
        if connection.is_reliable
    )


def under_way(probes: Probes, connections: Sequence[Connection]) -> list[str]:
    """Reliable connections with a packet or an acknowledgement that has not arrived."""
    return [
        str(connection)
        for connection, sent, received in _ends(probes, connections)
        if connection.is_reliable and sent != received
    ]


def is_drained(probes: Probes, connections: Sequence[Connection]) -> bool:
    """Whether no reliable packet is under way, and none waits that some hook could start on.

    In virtual time, all that happens counts, so no packet at all may be under way.
    """
    return not under_way(probes, connections) and not any(
        probe.is_startable or (probe.virtual_ns is not None and not probe.is_idle)
        for probe in probes.values()
    )


def is_dead(probes: Probes, connections: Sequence[Connection]) -> bool:
    """Whether no node can ever run a hook again."""
    return not under_way(probes, connections) and all(
        probe.is_idle and not probe.is_wakeable for probe in probes.values()
    )


def is_at_rest(probes: Probes, connections: Sequence[Connection], same_s: float) -> bool:
    """Whether nothing moves in a paused run whose nodes have all been started.

    ``same_s``: for how long the counters have been the same, in seconds. In virtual time, packets
    that are lost are not counted as sent.
    """
    under_way = [
        connection.is_reliable
        for connection, sent, received in _ends(probes, connections)
        if (sent != received if connection.is_reliable else sent[0] != received[0])
    ]
    is_virtual = any(probe.virtual_ns is not None for probe in probes.values())
    has_lost = bool(under_way) and not any(under_way) and not is_virtual
    return all(probe.is_active for probe in probes.values()) and (
        not under_way or (has_lost and same_s >= _LOST_AFTER_S)
    )


def waits(probes: Probes, connections: Sequence[Connection]) -> dict[str, dict[str, str]]:
    """The nodes that wait for each other, and why."""
    result: dict[str, dict[str, str]] = {name: {} for name in probes}
    for connection in connections:
        key = str(connection)
        sender, receiver = connection.source_node, connection.destination_node
        if sender not in probes or receiver not in probes:
            continue
        lacks = probes[receiver].lacks
        sent, acknowledged = probes[sender].sent[key]
        outstanding = sent - acknowledged
        # A packet to itself stays unread for as long as the node waits for another input: then
        # it is that input that it lacks.
        is_blocked = connection.is_reliable and outstanding >= connection.window
        if is_blocked and not (sender == receiver and lacks):
            result[sender].setdefault(
                receiver, f"is blocked on `{key}` ({outstanding} outstanding)"
            )
        if lacks == connection.destination_input and key not in probes[receiver].unread:
            result[receiver][sender] = f"waits for `{lacks}` from {sender}"
    return result


def cycle(waits: Waits) -> list[tuple[str, str]]:
    """A smallest ring of nodes that wait for each other, as ``(node, why)``; else every wait."""
    rings = [ring for node in sorted(waits) if (ring := _ring_through(node, _waited_for(waits)))]
    if not rings:
        return [(node, next(iter(why.values()))) for node, why in sorted(waits.items()) if why]
    ring = min(rings, key=len)
    return [(a, waits[a][b]) for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)]


def _waited_for(waits: Waits) -> Callable[[str], Iterable[str]]:
    return lambda node: sorted(waits.get(node, ()))


def _ring_through(start: _T, following: Callable[[_T], Iterable[_T]]) -> list[_T]:
    """The shortest way from a member of a graph back to itself; empty if there is none.

    ``following`` gives the members that one leads to.
    """
    paths = [[start]]
    seen: set[_T] = set()
    while paths:  # breadth first
        longer = []
        for path in paths:
            for each in following(path[-1]):
                if each == start:
                    return path
                if each not in seen:
                    seen.add(each)
                    longer.append([*path, each])
        paths = longer
    return []


def _ends(
    probes: Probes, connections: Sequence[Connection]
) -> Iterator[tuple[Connection, tuple[int, int], tuple[int, int]]]:
    """The counters at both ends of every connection between nodes that tell them."""
    for connection in connections:
        sender = probes.get(connection.source_node)
        receiver = probes.get(connection.destination_node)
        if sender and receiver and sender.sent:
            key = str(connection)
            if key in sender.sent:
                yield connection, sender.sent[key], receiver.received[key]


class DeclaredHook(control.HookDeclaration, frozen=True):
    """A hook as its plugin declares it; ``place`` is that among the hooks of its node's engine."""

    node: str = ""
    place: int = 0

    @property
    def required(self) -> list[InputSpec]:
        """The inputs without which it does not start."""
        return [port for port in self.inputs if not port.is_optional]

    @property
    def may_go_on(self) -> bool:
        """Whether it starts while its project drains."""
        return self.kind is HookKind.FUNCTION and bool(self.required or not self.outputs)


class Declarations:
    """The hooks of the nodes that have been loaded.

    Args:
        files: the nodes.
    """

    def __init__(self, files: Sequence[NodeFile]) -> None:
        self._connections = {connection for file in files for connection in file.connections}
        self._external = {
            (file.node.name, port.name)
            for file in files
            for port in file.node.inputs
            if port.external_topic is not None
        }
        self._hooks: dict[str, list[DeclaredHook]] = {}

    def add(self, message: control.Hooks) -> None:
        """Keep the declarations of a node, in the place of those before its reset."""
        node = message.node
        self._hooks[node] = [
            DeclaredHook(hook.kind, hook.inputs, hook.outputs, node, place)
            for place, hook in enumerate(message.hooks)
        ]

    def last_round(self, stopped: str) -> dict[str, tuple[int, ...]]:
        """By node, the places of the hooks that may start once more only, for the end to come.

        ``stopped`` is the node that starts no further hook, empty if there is none.
        """
        hooks = [hook for hooks in self._hooks.values() for hook in hooks]
        found: dict[str, list[int]] = {}
        for hook in last_round(hooks, self._connections, self._external, stopped):
            found.setdefault(hook.node, []).append(hook.place)
        return {node: tuple(places) for node, places in found.items()}


def last_round(
    hooks: Collection[DeclaredHook],
    connections: Collection[Connection],
    external: Collection[tuple[str, str]] = (),
    stopped: str = "",
) -> list[DeclaredHook]:
    """The hooks that have to be stopped for a draining project to come to its end.

    Those that could go on for ever are the largest set of which each hook gets its required inputs
    from others of the set (or from an external topic), and sends reliably to takers of the set
    only: any other taker starves, and its sender blocks. A hook of the set has to be stopped if it
    is in a ring of required inputs, or passes on what an external topic brings: the others only
    work off what these send.

    Args:
        hooks: of all nodes that are known; others count as resting.
        connections: with an end at one of these nodes.
        external: the inputs that are bound to an external topic, as ``(node, input)``.
        stopped: the node that starts no further hook.
    """
    known = {hook.node for hook in hooks}
    endless = {hook for hook in hooks if hook.may_go_on and hook.node != stopped}

    takers: dict[tuple[str, str], list[DeclaredHook]] = defaultdict(list)
    origins: dict[tuple[str, str], list[DeclaredHook]] = defaultdict(list)
    into: dict[tuple[str, str], list[Connection]] = defaultdict(list)
    out_of: dict[tuple[str, str], list[Connection]] = defaultdict(list)
    for hook in hooks:
        for port in hook.inputs if hook.kind is not HookKind.INITIALISE else ():
            takers[hook.node, port.name].append(hook)
        for output in hook.outputs:
            origins[hook.node, output].append(hook)
    for connection in connections:
        into[connection.destination_node, connection.destination_input].append(connection)
        out_of[connection.source_node, connection.source_output].append(connection)

    def senders(hook: DeclaredHook, port: InputSpec) -> list[list[DeclaredHook]]:
        """For each connection of an input, the hooks of the set that send on it."""
        return [
            [each for each in origins[c.source_node, c.source_output] if each in endless]
            for c in into[hook.node, port.name]
        ]

    def is_fed(hook: DeclaredHook, port: InputSpec) -> bool:
        if (hook.node, port.name) in external:
            return True
        found = senders(hook, port)
        return bool(found) and (all(found) if port.is_all else any(found))

    def is_free(hook: DeclaredHook) -> bool:
        return all(
            c.destination_node in known
            and endless.issuperset(takers[c.destination_node, c.destination_input])
            for output in hook.outputs
            for c in out_of[hook.node, output]
            if c.is_reliable
        )

    while ending := [
        hook
        for hook in endless
        if not (all(is_fed(hook, port) for port in hook.required) and is_free(hook))
    ]:
        endless.difference_update(ending)
    before = {
        hook: {h for port in hook.required for some in senders(hook, port) for h in some}
        for hook in endless
    }
    return sorted(
        (
            hook
            for hook in endless
            if _ring_through(hook, before.__getitem__)
            or (hook.outputs and any((hook.node, port.name) in external for port in hook.required))
        ),
        key=lambda hook: (hook.node, hook.place),
    )
