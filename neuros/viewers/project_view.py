"""Project as viewers get it: nodes, connections, topics, and ports that can be sampled."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from neuros.project.graph import guarantee
from neuros.project.model import Connection, Node, Port, Project
from neuros.project.names import Names
from neuros.viewers.visual_types import IMAGES


def project_view(project: Project, names: Sequence[str]) -> dict[str, Any]:
    """The project for viewers, ready for JSON.

    Args:
        names: the nodes of this run; the others run elsewhere, and nothing is seen of them.
    """
    return {
        "project": project.name,
        "nodes": [
            {
                "name": node.name,
                "container": node.container,
                "plugin": node.plugin.name,
                "is_here": node.name in names,
                "owns_time": node.owns_time,
            }
            for node in project.nodes
        ],
        "connections": [_connection(c) for c in project.connections],
        "topics": list(_topics(project)),
        "sources": [
            source
            for node in project.nodes
            if node.name in names
            for source in _sources(node, project.names)
        ],
    }


def _connection(connection: Connection) -> dict[str, Any]:
    return {
        "name": str(connection),
        "from": connection.source_node,
        "output": connection.source_output,
        "to": connection.destination_node,
        "input": connection.destination_input,
        "discard_limit": connection.discard_limit,
        "queue_size": connection.queue_size,
        "window": connection.window,
        "guarantee": guarantee(connection),
    }


def _topics(project: Project) -> Iterator[dict[str, Any]]:
    """External topics: ``name`` is as in the project file, ``title`` as on the ROS graph."""
    for node in project.nodes:
        for port in (*node.inputs, *node.outputs):
            if port.external_topic is not None:
                is_in, end = port in node.inputs, f"{node.name}.{port.name}"
                full = project.names.resolve(port.external_topic, node.name)
                name, title = (
                    f"{topic} -> {end}" if is_in else f"{end} -> {topic}"
                    for topic in (port.external_topic, full)
                )
                yield {
                    "name": name,
                    "title": title,
                    "topic": port.external_topic,
                    "full": full,
                    "node": node.name,
                    "is_in": is_in,
                }


def _sources(node: Node, names: Names) -> Iterator[dict[str, Any]]:
    """Ports whose packets can be sampled: outputs and external inputs."""
    for port in node.outputs:
        yield _source(node, port, port.name, port.name)
    for port in node.inputs:
        if port.external_topic is not None:
            full = names.resolve(port.external_topic, node.name)
            yield _source(node, port, port.external_topic, full)


def _source(node: Node, port: Port, key: str, title: str) -> dict[str, Any]:
    return {
        "node": node.name,
        "port": key,
        "name": f"{node.name}.{key}",
        "title": f"{node.name}.{title}",
        "type": port.type,
        "is_image": port.type in IMAGES,
    }
