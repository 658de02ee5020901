"""Layout of a project's graph: nodes in columns, connections from left to right.

Nodes stand in every other column, so that each has those behind it to its right; loops are broken
where the search comes back. Connections have boxes of their own in the columns between, and where
one passes a column it has a place there, too: nothing is drawn over anything. Within columns things
are ordered by where their neighbours are (Sugiyama et al. 1981, barycentres).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from neuros.project.model import Connection

_SWEEPS = 6


@dataclass(frozen=True)
class Place:
    """Column from the left, row from the top (0.0 is the middle of the picture)."""

    column: int
    row: float


@dataclass(frozen=True)
class Layout:
    """Where things are.

    Attributes:
        nodes: by name; boxes: of connections, by name.
        routes: of each connection, the places it goes through from sender to receiver.
    """

    nodes: Mapping[str, Place]
    boxes: Mapping[str, Place]
    routes: Mapping[str, Sequence[Place]]


def lay_out(nodes: Sequence[str], connections: Mapping[str, Connection], first: str) -> Layout:
    """Find places, with ``first`` in the left column if nothing leads to it but loops."""
    order = [first, *(node for node in nodes if node != first)]
    forward = _without_loops(order, connections)
    layer = _layers(order, connections, forward)
    columns: dict[int, list[str]] = {}
    links: list[tuple[str, str]] = []
    chains: dict[str, list[str]] = {}
    for node in order:
        columns.setdefault(2 * layer[node], []).append(f"node {node}")
    for name, c in connections.items():
        left, right = (
            (c.source_node, c.destination_node)
            if forward[name]
            else (c.destination_node, c.source_node)
        )
        start, end = 2 * layer[left], 2 * layer[right]
        chain = [f"node {left}", f"box {name}"]
        columns.setdefault(start + 1, []).append(f"box {name}")
        for column in range(start + 2, end):
            columns.setdefault(column, []).append(f"pass {column} {name}")
            chain.append(f"pass {column} {name}")
        chain.append(f"node {right}")
        links += itertools.pairwise(chain)
        chains[name] = chain if forward[name] else chain[::-1]
    places = _order(columns, links)
    return Layout(
        {node: places[f"node {node}"] for node in order},
        {name: places[f"box {name}"] for name in connections},
        {name: [places[key] for key in chain] for name, chain in chains.items()},
    )


def _without_loops(order: Sequence[str], connections: Mapping[str, Connection]) -> dict[str, bool]:
    """Which connections lead forward, if those that lead back to where a search came from do not.

    Depth first, without recursion: a project may be a chain of any length.
    """
    leaving: dict[str, list[tuple[str, str]]] = {node: [] for node in order}
    for name, c in connections.items():
        leaving[c.source_node].append((name, c.destination_node))
    forward: dict[str, bool] = {}
    state: dict[str, str] = {}
    for root in order:
        if root in state:
            continue
        stack = [(root, iter(leaving[root]))]
        state[root] = "open"
        while stack:
            node, rest = stack[-1]
            name, to = next(rest, ("", ""))
            if not name:
                state[node] = "done"
                stack.pop()
                continue
            forward[name] = state.get(to) != "open" or to == node
            if to not in state:
                state[to] = "open"
                stack.append((to, iter(leaving[to])))
    return forward


def _layers(
    order: Sequence[str], connections: Mapping[str, Connection], forward: Mapping[str, bool]
) -> dict[str, int]:
    """The longest way to each node from the left."""
    layer = dict.fromkeys(order, 0)
    for _ in order:
        has_changed = False
        for name, c in connections.items():
            ends = (c.source_node, c.destination_node)
            left, right = ends if forward[name] else ends[::-1]
            if left != right and layer[right] <= layer[left]:
                layer[right] = layer[left] + 1
                has_changed = True
        if not has_changed:
            break
    return layer


def _order(columns: Mapping[int, list[str]], links: Sequence[tuple[str, str]]) -> dict[str, Place]:
    neighbours: dict[str, list[str]] = {}
    for a, b in links:
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    rows: dict[str, float] = {}
    for keys in columns.values():
        rows.update(_centred(keys))
    for sweep in range(_SWEEPS):
        for column in sorted(columns, reverse=bool(sweep % 2)):
            wanted = {
                key: sum(rows[n] for n in neighbours.get(key, [key]))
                / len(neighbours.get(key, [key]))
                for key in columns[column]
            }
            rows.update(_centred(sorted(columns[column], key=lambda key: wanted[key])))
    return {key: Place(column, rows[key]) for column, keys in columns.items() for key in keys}


def _centred(keys: Sequence[str]) -> dict[str, float]:
    return {key: index - (len(keys) - 1) / 2 for index, key in enumerate(keys)}
