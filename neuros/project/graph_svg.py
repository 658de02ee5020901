"""A project as a picture for browsers and documents: SVG, made of text alone."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from xml.sax.saxutils import escape

from neuros.project.graph import guarantee, port_names
from neuros.project.layout import Layout, Place, lay_out
from neuros.project.model import Connection, Project

_PIXELS_PER_LETTER = 7.2
_PADDING, _LEAST_WIDTH = 24, 110
_GAP, _ROW, _HEIGHT = 56, 92, 54
_MARGIN = 20
_FONT = 'font-family="system-ui, Helvetica, Arial, sans-serif"'
_INK, _BLUE, _GREY = "#1d2733", "#1a66c2", "#7b8794"
_TOPIC = "topic "


def graph_svg(project: Project) -> str:
    """The nodes, and between them the connections: thick lossless, dashed best effort."""
    ends = {str(c): c for c in project.connections}
    ends |= {str(c): c for c in _topic_ends(project, len(ends))}
    names = [node.name for node in project.nodes]
    names += dict.fromkeys(
        name
        for c in ends.values()
        for name in (c.source_node, c.destination_node)
        if name.startswith(_TOPIC)
    )
    first = next((n.name for n in project.nodes if n.owns_time), names[0])
    return "\n".join(_Picture(project, names, ends, lay_out(names, ends, first)).lines()) + "\n"


def _topic_ends(project: Project, index: int) -> Iterator[Connection]:
    """External topics as what they are in the picture: ends of connections."""
    number = itertools.count(index)
    for node in project.nodes:
        for port in node.inputs:
            if port.external_topic is not None:
                topic = f"{_TOPIC}{port.external_topic}"
                yield Connection(topic, "", node.name, port.name, index=next(number))
        for port in node.outputs:
            if port.external_topic is not None:
                topic = f"{_TOPIC}{port.external_topic}"
                yield Connection(node.name, port.name, topic, "", index=next(number))


class _Picture:
    """One drawing; lengths are pixels."""

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
            self._texts[layout.nodes[name]] = self._node_texts(name)
        for name, place in layout.boxes.items():
            self._texts[place] = _connection_texts(ends[name])
        self._widths = {
            place: max(_LEAST_WIDTH, _PADDING + max(map(len, texts)) * _PIXELS_PER_LETTER)
            for place, texts in self._texts.items()
        }
        self._left = self._columns()
        self._shifts = self._places_along_sides()
        rows = [place.row for route in layout.routes.values() for place in route]
        rows += [place.row for place in self._texts]
        self._top, self._bottom = min(rows), max(rows)

    def lines(self) -> Iterator[str]:
        """The file, line by line."""
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

    def _node_texts(self, name: str) -> tuple[str, str]:
        if name.startswith(_TOPIC):
            return name.removeprefix(_TOPIC), "topic"
        return name, self._project.node(name).container

    def _columns(self) -> list[float]:
        """Where each column begins, and after the last one where the next would."""
        last = max(place.column for place in self._texts)
        left = [float(_MARGIN)]
        for column in range(last + 1):
            widths = [w for place, w in self._widths.items() if place.column == column]
            left.append(left[-1] + max(widths, default=0.0) + _GAP)
        return left

    def _at(self, place: Place) -> tuple[float, float]:
        begin, end = self._left[place.column], self._left[place.column + 1] - _GAP
        y = (place.row - self._top) * _ROW + _HEIGHT / 2 + _MARGIN
        return (begin + end) / 2, y

    def _places_along_sides(self) -> dict[tuple[Place, Place], float]:
        """How far from the middle of a node's side a line to a neighbour begins or ends."""
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
        """From the sender's side through the connection's box to the receiver's."""
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


def _connection_texts(connection: Connection) -> tuple[str, str]:
    is_topic = not (connection.source_output and connection.destination_input)
    return port_names(connection), "topic" if is_topic else guarantee(connection)


def _marker(colour: str) -> str:
    """The head of an arrow."""
    return (
        f'<marker id="{_marker_name(colour)}" viewBox="0 0 10 10" refX="9" refY="5"'
        ' markerWidth="12" markerHeight="12" markerUnits="userSpaceOnUse" orient="auto">'
        f'<path d="M0 0 10 5 0 10z" fill="{colour}"/></marker>'
    )


def _marker_name(colour: str) -> str:
    return f"arrow-{colour.removeprefix('#')}"


def _colour(connection: Connection) -> str:
    return _BLUE if connection.is_reliable else _GREY
