"""A project as a picture: in plain text for terminals and code blocks, and for Mermaid."""

from __future__ import annotations

from collections.abc import Iterator

from neuros.project.model import Connection, Node, Port, Project


def graph_text(project: Project) -> str:
    """The nodes with their outputs, and where these lead, in aligned plain text.

    ::

        clock: 2 nodes, 1 connection

        ticker  (neuros_python, ticker.py)
          out tick  std_msgs/msg/String
              -> printer.tick   lossless

        printer  (neuros_python, printer.py)
          in  tick  std_msgs/msg/String
              <- ticker.tick
    """
    nodes, connections = len(project.nodes), len(project.connections)
    lines = [f"{project.name}: {_count(nodes, 'node')}, {_count(connections, 'connection')}"]
    if project.description:
        lines.append(project.description)
    for node in project.nodes:
        lines += ["", *_node_lines(project, node)]
    return "\n".join(lines) + "\n"


def graph_mermaid(project: Project) -> str:
    """The same for Mermaid: thick arrows are lossless, dotted ones best effort."""
    identity = {node.name: f"n{index}" for index, node in enumerate(project.nodes)}
    lines = ["flowchart LR"]
    for node in project.nodes:
        lines.append(f'    {identity[node.name]}["{node.name}<br/>{_safe(node.container)}"]')
    for c in project.connections:
        lines.append(
            f'    {identity[c.source_node]} {_arrow(c)}|"{port_names(c)}<br/>{guarantee(c)}"| '
            f"{identity[c.destination_node]}"
        )
    topics: dict[str, str] = {}
    for node in project.nodes:
        for port, is_input in _external(node):
            topic = project.names.resolve(str(port.external_topic), node.name)
            if topic not in topics:
                topics[topic] = f"t{len(topics)}"
                lines.append(f'    {topics[topic]}(["{_safe(topic)}"])')
            ends = [topics[topic], identity[node.name]]
            source, destination = ends if is_input else reversed(ends)
            lines.append(f'    {source} -.->|"{port.name}"| {destination}')
    return "\n".join(lines) + "\n"


def port_names(connection: Connection) -> str:
    """The output and the input, or their common name; one that has none is left out."""
    names = dict.fromkeys((connection.source_output, connection.destination_input))
    return " → ".join(name for name in names if name)


def guarantee(connection: Connection) -> str:
    """What a connection promises, in words."""
    if connection.discard_limit is None:
        words = "best effort"
    elif connection.discard_limit == 0:
        words = "lossless"
    else:
        words = f"discards <= {connection.discard_limit}"
    if connection.compression is not None:
        words += f", {connection.compression}"
    return words + (f", queue {connection.queue_size}" if connection.queue_size > 1 else "")


def _node_lines(project: Project, node: Node) -> Iterator[str]:
    yield f"{node.name}  ({node.container}, {node.plugin_name})"
    ports = [*((port, "in ") for port in node.inputs), *((port, "out") for port in node.outputs)]
    width = max((len(port.name) for port, _ in ports), default=0)
    for port, side in ports:
        yield f"  {side} {port.name:<{width}}  {port.type}"
        yield from _ends(project, node, port, is_input=side == "in ")


def _ends(project: Project, node: Node, port: Port, *, is_input: bool) -> Iterator[str]:
    if port.external_topic is not None:
        topic = project.names.resolve(port.external_topic, node.name)
        yield f"      {'<-' if is_input else '->'} topic {topic}"
        return
    if is_input:
        sources = [c for c in project.connections if _to(c) == (node.name, port.name)]
        yield from (f"      <- {c.source_node}.{c.source_output}" for c in sources)
        connected = bool(sources)
    else:
        targets = [c for c in project.connections if _from(c) == (node.name, port.name)]
        names = [".".join(_to(c)) for c in targets]
        width = max(map(len, names), default=0)
        for name, c in zip(names, targets, strict=True):
            yield f"      -> {name:<{width}}   {guarantee(c)}"
        connected = bool(targets)
    if not connected:
        yield "      not connected"


def _from(connection: Connection) -> tuple[str, str]:
    return connection.source_node, connection.source_output


def _to(connection: Connection) -> tuple[str, str]:
    return connection.destination_node, connection.destination_input


def _external(node: Node) -> Iterator[tuple[Port, bool]]:
    for ports, is_input in ((node.inputs, True), (node.outputs, False)):
        yield from ((port, is_input) for port in ports if port.external_topic is not None)


def _arrow(connection: Connection) -> str:
    if connection.discard_limit is None:
        return "-.->"
    return "==>" if connection.discard_limit == 0 else "-->"


def _safe(text: str) -> str:
    return text.replace('"', "#quot;")


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
