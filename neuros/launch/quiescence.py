"""Whether anything can still happen in a project: judged from the probes of all its nodes.

A probe is a report that a node makes between two events. Probes of different nodes are not made at
the same instant, so one round of them can miss a packet that is under way; two rounds with the same
counters cannot (F. Mattern, "Algorithms for distributed termination detection", 1987).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neuros.project.model import Connection

Probes = Mapping[str, Mapping[str, Any]]
"""The newest probe by node."""


def counters(probes: Probes) -> tuple[Any, ...]:
    """All that must stay the same from one round to the next."""
    return tuple(
        (
            name,
            tuple(
                (key, c["sent"], c["acknowledged"])
                for key, c in sorted(probe["ledger"]["outgoing"].items())
            ),
            tuple(
                (key, c["received"], c["acknowledged"])
                for key, c in sorted(probe["ledger"]["incoming"].items())
            ),
            tuple(
                (key, hook["executions"]) for key, hook in sorted(probe["ledger"]["hooks"].items())
            ),
        )
        for name, probe in sorted(probes.items())
    )


def nothing_is_under_way(probes: Probes, connections: Sequence[Connection]) -> bool:
    """Whether every packet and acknowledgement on a reliable connection has arrived."""
    for connection in connections:
        if not connection.is_reliable:
            continue
        key = str(connection)
        sender = probes[connection.source_node]["ledger"]["outgoing"][key]
        receiver = probes[connection.destination_node]["ledger"]["incoming"][key]
        if sender["sent"] != receiver["received"]:
            return False
        if sender["acknowledged"] != receiver["acknowledged"]:
            return False
    return True


def is_drained(probes: Probes, connections: Sequence[Connection]) -> bool:
    """Whether no packet is under way, and none waits that some hook could start on."""
    return nothing_is_under_way(probes, connections) and not any(
        probe["is_startable"] or not probe["is_idle"] for probe in probes.values()
    )


def is_dead(probes: Probes, connections: Sequence[Connection]) -> bool:
    """Whether no node can ever run a hook again."""
    return nothing_is_under_way(probes, connections) and all(
        probe["is_running"] and probe["is_idle"] and not probe["is_wakeable"]
        for probe in probes.values()
    )


def cycle(waits: Mapping[str, Mapping[str, str]]) -> list[tuple[str, str]]:
    """A ring of nodes that wait for each other, as ``(node, why)``; all of them if there is none.

    ``waits[node]`` maps the nodes that it waits for to the reason.
    """
    for start in sorted(waits):
        path: list[str] = []
        node = start
        while node in waits and waits[node] and node not in path:
            path.append(node)
            node = min(waits[node])
        if node in path:
            ring = path[path.index(node) :]
            follow = [*ring[1:], ring[0]]
            return [(a, waits[a][b]) for a, b in zip(ring, follow, strict=True)]
    return [(node, next(iter(why.values()))) for node, why in sorted(waits.items()) if why]


def waits(probes: Probes, connections: Sequence[Connection]) -> dict[str, dict[str, str]]:
    """Who waits for whom: ``waits[node][other] = reason``."""
    result: dict[str, dict[str, str]] = {name: {} for name in probes}
    for connection in connections:
        key = str(connection)
        sender, receiver = connection.source_node, connection.destination_node
        if sender not in probes or receiver not in probes:
            continue
        outgoing = probes[sender]["ledger"]["outgoing"][key]
        if outgoing["is_blocked"]:
            outstanding = outgoing["outstanding"]
            result[sender][receiver] = f"is blocked on {key} ({outstanding} outstanding)"
        state = probes[receiver]["ledger"]["state"]
        if state["state"] == "waiting" and state["cause"] == connection.destination_input:
            result[receiver].setdefault(
                sender, f"waits for '{connection.destination_input}' from {sender}"
            )
    return result
