"""One project file for the user, one ``node.json`` per node, and both as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from neuros.project.message_types import with_copies
from neuros.project.model import (
    FINALISE_S,
    Budgets,
    Connection,
    Folders,
    Node,
    NodeFile,
    Port,
    Project,
    access_of,
    durations_of,
    keys_of,
    parameters_of,
    parameters_to_json,
    resources_of,
)
from neuros.project.names import names_from, names_to_json
from neuros.project.paths import find_module, is_module_name
from neuros.project.qos import qos_of, qos_to_json
from neuros.project.timing import REAL, seed_of


def split(project: Project, folders_for: Callable[[Node], Folders]) -> tuple[NodeFile, ...]:
    """Cut a project into one part per node, in the order of the nodes."""
    seed = seed_of(project.nodes) if project.is_virtual else ""
    return tuple(
        NodeFile(
            node=node,
            connections=tuple(
                connection
                for connection in project.connections
                if node.name in (connection.source_node, connection.destination_node)
            ),
            folders=folders_for(node),
            index=index,
            names=project.names,
            time=project.time,
            seed=seed,
        )
        for index, node in enumerate(project.nodes)
    )


def node_file_to_json(node_file: NodeFile) -> dict[str, Any]:
    node = node_file.node
    return {
        "node": {**_node_keys(node), "environment": dict(node.environment)},
        "connections": [
            {**connection.keys, "index": connection.index} for connection in node_file.connections
        ],
        "folders": {name: str(folder) for name, folder in vars(node_file.folders).items()},
        "messages": [str(path) for path in node_file.messages],
        "index": node_file.index,
        "list_bytes": node_file.list_bytes,
        "restored": dict(node_file.restored),
        "file": str(node.file),
        "pointer": node.pointer,
        "environment_paths": list(node.environment_paths),
        **({"time": node_file.time, "seed": node_file.seed} if node_file.time != REAL else {}),
        **names_to_json(node_file.names),
    }


def node_file_text(node_file: NodeFile) -> str:
    return json.dumps(node_file_to_json(node_file), indent=2) + "\n"


def node_file_from_json(content: Mapping[str, Any]) -> NodeFile:
    """The inverse of :func:`node_file_to_json`; raises ``KeyError`` for anything else."""
    node = content["node"]
    script, copies = node.get("script"), node.get("copies")
    module = node["plugin"] if is_module_name(node["plugin"]) else ""
    names = names_from(content.get("namespace", ""), content.get("remap", {}))
    return NodeFile(
        node=Node(
            name=node["name"],
            container=node["container"],
            plugin=(find_module(module) or Path()) if module else Path(node["plugin"]),
            module=module,
            script=None if script is None else Path(script),
            inputs=tuple(_port(port, copies, is_input=True) for port in node.get("inputs", ())),
            outputs=tuple(_port(port, copies, is_input=False) for port in node.get("outputs", ())),
            environment=dict(node.get("environment", {})),
            file=Path(content["file"]),
            pointer=content["pointer"],
            environment_paths=tuple(content.get("environment_paths", ())),
            affinity=tuple(node.get("affinity", ())),
            resources=resources_of(node),
            access=access_of(node),
            parameters=parameters_of(node.get("parameters", {})),
            finalise_s=node.get("finalise_s", FINALISE_S),
            copies=copies,
            durations=durations_of(node.get("durations", {})),
        ),
        connections=tuple(
            Connection.of(keys, namespace=names.namespace) for keys in content["connections"]
        ),
        folders=Folders(**{key: Path(path) for key, path in content["folders"].items()}),
        index=content["index"],
        messages=tuple(map(Path, content.get("messages", ()))),
        names=names,
        restored=content.get("restored", {}),
        time=content.get("time", REAL),
        seed=content.get("seed", ""),
        **({"list_bytes": content["list_bytes"]} if "list_bytes" in content else {}),
    )


def node_files_from_json(contents: Iterable[Mapping[str, Any]]) -> list[NodeFile]:
    """The node files of a process.

    A connection between two of the nodes is one object, so that a look-up finds it without a
    comparison of all fields.
    """
    files = [node_file_from_json(content) for content in contents]
    known: dict[Connection, Connection] = {}
    return [
        replace(file, connections=tuple(known.setdefault(c, c) for c in file.connections))
        for file in files
    ]


def project_to_json(project: Project) -> dict[str, Any]:
    """The expanded project: every node in place, every path absolute, every value a text.

    The result is a valid project file for the folder of the original project.
    """
    content: dict[str, Any] = {"description": project.description} if project.description else {}
    content["nodes"] = [
        {
            **_node_keys(node),
            "environment": {k: _written(node, k, value) for k, value in node.environment.items()},
        }
        for node in project.nodes
    ]
    content["connections"] = [connection.keys for connection in project.connections]
    content |= names_to_json(project.names)
    if project.is_portable:
        content["portable"] = True
    if project.is_virtual:
        content["time"] = project.time
    if budgets := budgets_to_json(project.budgets):
        content["budgets"] = budgets
    if project.dashboard is not None:
        content["dashboard"] = project.dashboard
    return content


def budgets_to_json(budgets: Budgets) -> dict[str, Any]:
    values = {**vars(budgets), "lost_packets": dict(budgets.lost_packets)}
    return {key: value for key, value in values.items() if value not in (None, {})}


def translated(node: Node, translate: Callable[[Path], Path]) -> Node:
    """The node with the paths of its plugin, script and environment translated.

    The path of the file that describes the node stays: it is for messages to the user.
    """
    return replace(
        node,
        plugin=translate(node.plugin),
        script=None if node.script is None else translate(node.script),
        environment={
            key: str(translate(Path(value))) if key in node.environment_paths else value
            for key, value in node.environment.items()
        },
    )


def _node_keys(node: Node) -> dict[str, Any]:
    optional = {
        "script": "" if node.script is None else str(node.script),
        "affinity": list(node.affinity),
        **keys_of(node.resources, node.access),
        "parameters": parameters_to_json(node.parameters),
        "finalise_s": 0 if node.finalise_s == FINALISE_S else node.finalise_s,
        "copies": node.copies,
        "durations": {hook: duration.keys for hook, duration in node.durations.items()},
    }
    return {
        "name": node.name,
        "container": node.container,
        "plugin": node.module or str(node.plugin),
        **{key: value for key, value in optional.items() if value},
        "inputs": [_port_keys(port, node.copies) for port in node.inputs],
        "outputs": [_port_keys(port, node.copies) for port in node.outputs],
    }


def _port(keys: Mapping[str, Any], copies: int | None, *, is_input: bool) -> Port:
    port = Port(**{key: value for key, value in keys.items() if key != "qos"})
    port = replace(port, type=with_copies(port.type, copies))
    return replace(port, qos=qos_of(keys["qos"], is_input=is_input)) if "qos" in keys else port


def _port_keys(port: Port, copies: int | None) -> dict[str, Any]:
    qos = None if port.qos is None else qos_to_json(port.qos)
    keys = {**vars(port), "mujoco": dict(port.mujoco) or None, "qos": qos}
    if copies is not None and port.array:
        keys["type"] = str(port.array.of_one_copy)
    return {key: value for key, value in keys.items() if value is not None}


def _written(node: Node, key: str, value: str) -> str:
    """The value of an environment variable in a project file."""
    if key in node.environment_paths:
        return f"#{value}"
    return value[0] + value if value[:1] in ("#", "@") else value
