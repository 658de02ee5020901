"""The graph of a project: in plain text for terminals and code blocks, and for Mermaid."""

from __future__ import annotations

from collections.abc import Iterator

from neuros.project.model import Connection, Node, Port, Project
from neuros.project.suggest import counted


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
    lines = [f"{project.name}: {counted(nodes, 'node')}, {counted(connections, 'connection')}"]
    if project.description:
        lines.append(project.description)
    for node in project.nodes:
        lines += ["", f"{node.name}  ({node.container}, {node.plugin_name})"]
        ports = [
            *((port, "in ") for port in node.inputs),
            *((port, "out") for port in node.outputs),
        ]
        width = max((len(port.name) for port, _ in ports), default=0)
        for port, side in ports:
            lines.append(f"  {side} {port.name:<{width}}  {port.type}")
            lines += _ends(project, node, port, is_input=side == "in ")
    return "\n".join(lines) + "\n"


def graph_mermaid(project: Project) -> str:
    """The graph for Mermaid: thick arrows are lossless, dotted ones best effort."""
    identity = {node.name: f"n{index}" for index, node in enumerate(project.nodes)}
    lines = ["flowchart LR"]
    for node in project.nodes:
        lines.append(f'    {identity[node.name]}["{node.name}<br/>{_safe(node.container)}"]')
    for c in project.connections:
        arrow = "==>" if c.discard_limit == 0 else "-->" if c.is_reliable else "-.->"
        lines.append(
            f'    {identity[c.source_node]} {arrow}|"{port_names(c)}<br/>{guarantee(c)}"| '
            f"{identity[c.destination_node]}"
        )
    topics: dict[str, str] = {}
    for node in project.nodes:
        for port, is_input in external_ports(node):
            topic = project.names.resolve(str(port.external_topic), node.name)
            if topic not in topics:
                topics[topic] = f"t{len(topics)}"
                lines.append(f'    {topics[topic]}(["{_safe(topic)}"])')
            ends = [topics[topic], identity[node.name]]
            source, destination = ends if is_input else reversed(ends)
            lines.append(f'    {source} -.->|"{port.name}"| {destination}')
    return "\n".join(lines) + "\n"


def port_names(connection: Connection) -> str:
    """The names of output and input, or their common name; an empty name is left out."""
    names = dict.fromkeys((connection.source_output, connection.destination_input))
    return " → ".join(name for name in names if name)


def guarantee(connection: Connection) -> str:
    if connection.discard_limit is None:
        words = "best effort"
    elif connection.discard_limit == 0:
        words = "lossless"
    else:
        words = f"discards <= {connection.discard_limit}"
    if connection.compression is not None:
        words += f", {connection.compression}"
    return words + (f", queue {connection.queue_size}" if connection.queue_size > 1 else "")


def _ends(project: Project, node: Node, port: Port, *, is_input: bool) -> Iterator[str]:
    if port.external_topic is not None:
        topic = project.names.resolve(port.external_topic, node.name)
        yield f"      {'<-' if is_input else '->'} topic {topic}"
        return
    own = (node.name, port.name)
    if is_input:
        lines = [
            f"<- {c.source_node}.{c.source_output}"
            for c in project.connections
            if (c.destination_node, c.destination_input) == own
        ]
    else:
        targets = {
            f"{c.destination_node}.{c.destination_input}": c
            for c in project.connections
            if (c.source_node, c.source_output) == own
        }
        width = max(map(len, targets), default=0)
        lines = [f"-> {name:<{width}}   {guarantee(c)}" for name, c in targets.items()]
    yield from (f"      {line}" for line in lines or ["not connected"])


def external_ports(node: Node) -> Iterator[tuple[Port, bool]]:
    """The ports with an external topic, and whether each is an input."""
    for ports, is_input in ((node.inputs, True), (node.outputs, False)):
        yield from ((port, is_input) for port in ports if port.external_topic is not None)


def _safe(text: str) -> str:
    return text.replace('"', "#quot;")
