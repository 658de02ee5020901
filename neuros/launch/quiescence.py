"""Whether anything can still happen in a project: judged from the probes of all its nodes.

A probe is a report that a node makes between two events. Probes of different nodes are not made at
the same instant, so one round of them can miss a packet that is under way; two rounds with the same
counters cannot (F. Mattern, "Algorithms for distributed termination detection", 1987).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from neuros.project.model import Connection

Probes = Mapping[str, Mapping[str, Any]]
"""The newest probe by node."""

Waits = Mapping[str, Mapping[str, str]]
"""``waits[node]`` maps the nodes that it waits for to the reason."""


def counters(probes: Probes) -> tuple[Any, ...]:
    """All that happens in a project, counted: it rests if this stays the same."""
    return tuple(
        (
            name,
            tuple(
                (key, c["sent"], c["acknowledged"])
                for key, c in sorted(probe["metrics"]["outgoing"].items())
            ),
            tuple(
                (key, c["received"], c["acknowledged"])
                for key, c in sorted(probe["metrics"]["incoming"].items())
            ),
            tuple(
                (key, hook["executions"]) for key, hook in sorted(probe["metrics"]["hooks"].items())
            ),
        )
        for name, probe in sorted(probes.items())
    )


def reliable_counters(
    probes: Probes, connections: Sequence[Connection]
) -> tuple[tuple[int, ...], ...]:
    """What happens on reliable connections, counted; packets that may be lost flood on."""
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
        probe["is_startable"] for probe in probes.values()
    )


def is_dead(probes: Probes, connections: Sequence[Connection]) -> bool:
    """Whether no node can ever run a hook again."""
    return not under_way(probes, connections) and all(
        probe["is_running"] and probe["is_idle"] and not probe["is_wakeable"]
        for probe in probes.values()
    )


def waits(probes: Probes, connections: Sequence[Connection]) -> dict[str, dict[str, str]]:
    """Who waits for whom, and why."""
    result: dict[str, dict[str, str]] = {name: {} for name in probes}
    for connection in connections:
        key = str(connection)
        sender, receiver = connection.source_node, connection.destination_node
        if sender not in probes or receiver not in probes:
            continue
        state = probes[receiver]["metrics"]["state"]
        is_waiting = state["state"] == "waiting"
        outgoing = probes[sender]["metrics"]["outgoing"][key]
        # A packet to itself stays unread for as long as the node waits for another input: then
        # it is that input that it lacks.
        if outgoing["is_blocked"] and not (sender == receiver and is_waiting):
            outstanding = outgoing["outstanding"]
            result[sender].setdefault(
                receiver, f"is blocked on `{key}` ({outstanding} outstanding)"
            )
        is_cause = is_waiting and state["cause"] == connection.destination_input
        if is_cause and not probes[receiver]["metrics"]["incoming"][key]["unread"]:
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
) -> Iterator[tuple[Connection, Mapping[str, Any], Mapping[str, Any]]]:
    """Both ends' books of every reliable connection between nodes that were probed."""
    for connection in connections:
        sender = probes.get(connection.source_node)
        receiver = probes.get(connection.destination_node)
        if connection.is_reliable and sender and receiver:
            key = str(connection)
            yield (
                connection,
                sender["metrics"]["outgoing"][key],
                receiver["metrics"]["incoming"][key],
            )
