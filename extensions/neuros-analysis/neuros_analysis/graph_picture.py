"""A project as a picture, in SVG: its layout, and the file."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from neuros.project.graph import external_ports, guarantee, port_names
from neuros.project.model import Connection, Project

# Nodes stand in every other column, so that each has its receivers to its right; a connection that
# closes a loop points back. Connections have boxes of their own in the columns between, and a place
# in each column that they pass: nothing is drawn over anything. Within columns, things are ordered
# by where their neighbours are (Sugiyama et al. 1981, barycentres).


_SWEEPS = 6


@dataclass(frozen=True)
class Place:
    """Column from the left, row from the top; row 0.0 is the middle of the picture."""

    column: int
    row: float


@dataclass(frozen=True)
class Layout:
    """The places of a graph.

    Attributes:
        nodes: by name.
        boxes: of connections, by name.
        routes: of each connection, its places from sender to receiver.
    """

    nodes: Mapping[str, Place]
    boxes: Mapping[str, Place]
    routes: Mapping[str, Sequence[Place]]


def lay_out(nodes: Sequence[str], connections: Mapping[str, Connection], first: str) -> Layout:
    """Lay out a graph, with ``first`` in the left column if only loops lead to it."""
    order = [first, *(node for node in nodes if node != first)]
    forward = _without_loops(order, connections)
    layer = dict.fromkeys(order, 0)  # the longest way from the left
    for _ in order:
        before = dict(layer)
        for name, c in connections.items():
            ends = (c.source_node, c.destination_node)
            left, right = ends if forward[name] else ends[::-1]
            if left != right:
                layer[right] = max(layer[right], layer[left] + 1)
        if layer == before:
            break
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
    """Whether each connection leads forward, or back to a node that a depth-first search came from.

    The search does not recurse: a project may be a chain of any length.
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


# ---------------------------------------------------------------------- SVG


_PIXELS_PER_LETTER = 7.2
_PADDING, _LEAST_WIDTH = 24, 110
_GAP, _ROW, _HEIGHT = 56, 92, 54
_MARGIN = 20
_FONT = 'font-family="system-ui, Helvetica, Arial, sans-serif"'
_INK, _BLUE, _GREY = "#1d2733", "#1a66c2", "#7b8794"
_TOPIC = "topic "


def graph_svg(project: Project) -> str:
    """The nodes, and between them the connections: thick lossless, dashed best effort.

    External topics are drawn as nodes, with a connection to each of their ports.
    """
    ends = {str(c): c for c in project.connections}
    for node in project.nodes:
        for port, is_input in external_ports(node):
            own, topic = (node.name, port.name), (f"{_TOPIC}{port.external_topic}", "")
            sides = (*topic, *own) if is_input else (*own, *topic)
            connection = Connection(*sides, index=len(ends))
            ends[str(connection)] = connection
    names = [node.name for node in project.nodes]
    names += dict.fromkeys(
        name
        for c in ends.values()
        for name in (c.source_node, c.destination_node)
        if name.startswith(_TOPIC)
    )
    first = next((n.name for n in project.nodes if n.owns_time), names[0])
    return "\n".join(_Picture(project, names, ends, lay_out(names, ends, first)).lines()) + "\n"


class _Picture:
    """A drawing; lengths are in pixels."""

    def __init__(
        self,
        project: Project,
        names: Sequence[str],
        ends: dict[str, Connection],
        layout: Layout,
    ) -> None:
        self._project, self._ends, self._layout = project, ends, layout
        self._texts: dict[Place, tuple[str, str]] = {}
        for name in names:
            is_topic = name.startswith(_TOPIC)
            container = "topic" if is_topic else project.node(name).container
            self._texts[layout.nodes[name]] = (name.removeprefix(_TOPIC), container)
        for name, place in layout.boxes.items():
            c = ends[name]
            is_topic = not (c.source_output and c.destination_input)
            self._texts[place] = (port_names(c), "topic" if is_topic else guarantee(c))
        self._widths = {
            place: max(_LEAST_WIDTH, _PADDING + max(map(len, texts)) * _PIXELS_PER_LETTER)
            for place, texts in self._texts.items()
        }
        # The left edge of each column, and of a further one.
        self._left = [float(_MARGIN)]
        for column in range(max(place.column for place in self._texts) + 1):
            widths = [w for place, w in self._widths.items() if place.column == column]
            self._left.append(self._left[-1] + max(widths, default=0.0) + _GAP)
        self._shifts = self._places_along_sides()
        rows = [place.row for route in layout.routes.values() for place in route]
        rows += [place.row for place in self._texts]
        self._top, self._bottom = min(rows), max(rows)

    def lines(self) -> Iterator[str]:
        width = self._left[-1] - _GAP + _MARGIN
        height = (self._bottom - self._top) * _ROW + _HEIGHT + 2 * _MARGIN
        title = escape(self._project.name)
        yield (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}"'
            f' viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{title}">'
        )
        yield f"<title>{title}</title>"
        yield f"<defs>{''.join(map(_marker, (_BLUE, _GREY)))}</defs>"
        yield '<rect width="100%" height="100%" fill="#ffffff"/>'
        for name, route in self._layout.routes.items():
            yield self._route(self._ends[name], route)
        for name, place in self._layout.boxes.items():
            yield from self._box(place, "#ffffff", _colour(self._ends[name]), 10)
        for name, place in self._layout.nodes.items():
            is_topic = name.startswith(_TOPIC)
            yield from self._box(place, "#ffffff" if is_topic else "#eaf1fa", _INK, 6)
        yield "</svg>"

    def _at(self, place: Place) -> tuple[float, float]:
        begin, end = self._left[place.column], self._left[place.column + 1] - _GAP
        y = (place.row - self._top) * _ROW + _HEIGHT / 2 + _MARGIN
        return (begin + end) / 2, y

    def _places_along_sides(self) -> dict[tuple[Place, Place], float]:
        """By node and neighbour, how far from the middle of the node's side their line ends."""
        neighbours: dict[tuple[Place, bool], set[Place]] = {}
        for route in self._layout.routes.values():
            for node, other in ((route[0], route[1]), (route[-1], route[-2])):
                neighbours.setdefault((node, other.column > node.column), set()).add(other)
        shifts = {}
        for (node, _), others in neighbours.items():
            step = (_HEIGHT - 14) / len(others)
            for number, other in enumerate(sorted(others, key=lambda place: place.row)):
                shifts[node, other] = (number - (len(others) - 1) / 2) * step
        return shifts

    def _box(self, place: Place, fill: str, edge: str, radius: int) -> Iterator[str]:
        (x, y), width = self._at(place), self._widths[place]
        yield (
            f'<rect x="{x - width / 2:.1f}" y="{y - _HEIGHT / 2:.1f}" width="{width:.1f}"'
            f' height="{_HEIGHT}" rx="{radius}" fill="{fill}" stroke="{edge}"/>'
        )
        head, small = map(escape, self._texts[place])
        style = f'text-anchor="middle" {_FONT} fill="{_INK}"'
        yield (
            f'<text x="{x:.1f}" y="{y - 4:.1f}" {style} font-size="13" font-weight="600">'
            f"{head}</text>"
        )
        yield f'<text x="{x:.1f}" y="{y + 15:.1f}" {style} font-size="12">{small}</text>'

    def _route(self, connection: Connection, route: Sequence[Place]) -> str:
        parts = []
        for a, b in itertools.pairwise(route):
            (x, y), (to_x, to_y) = self._at(a), self._at(b)
            y, to_y = y + self._shifts.get((a, b), 0.0), to_y + self._shifts.get((b, a), 0.0)
            side = 1 if to_x > x else -1
            x += side * self._widths.get(a, 0.0) / 2
            to_x -= side * self._widths.get(b, 0.0) / 2
            middle = (x + to_x) / 2
            parts.append(
                f"M{x:.1f} {y:.1f}C{middle:.1f} {y:.1f} {middle:.1f} {to_y:.1f}"
                f" {to_x:.1f} {to_y:.1f}"
            )
        width = 3 if connection.discard_limit == 0 else 1.5
        dashes = "" if connection.is_reliable else ' stroke-dasharray="5 4"'
        colour = _colour(connection)
        return (
            f'<path d="{"".join(parts)}" fill="none" stroke="{colour}" stroke-width="{width}"'
            f'{dashes} marker-end="url(#{_marker_name(colour)})"/>'
        )


def _marker(colour: str) -> str:
    return (
        f'<marker id="{_marker_name(colour)}" viewBox="0 0 10 10" refX="9" refY="5"'
        ' markerWidth="12" markerHeight="12" markerUnits="userSpaceOnUse" orient="auto">'
        f'<path d="M0 0 10 5 0 10z" fill="{colour}"/></marker>'
    )


def _marker_name(colour: str) -> str:
    return f"arrow-{colour.removeprefix('#')}"


def _colour(connection: Connection) -> str:
    return _BLUE if connection.is_reliable else _GREY
