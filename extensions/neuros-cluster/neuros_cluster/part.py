"""One node of an exported project, where each container starts its own node.

Each container has a launcher for one node, and these launchers are peers
(:mod:`neuros.launcher.peers`). The export has checked the project, so a part only needs the
``node.json`` files, which one file holds for all nodes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.api.plan import Network, Plan, check_machine, chosen_network
from neuros.api.request import Request
from neuros.backends.process_launchers import PROCESS
from neuros.cli.launch import signals_noted
from neuros.errors import EnvironmentFault, UsageError
from neuros.options import add_options, options_of, values_of
from neuros.project.model import Budgets, NodeFile, Project
from neuros.project.names import Names
from neuros.project.split import budgets_to_json, node_file_to_json, node_files_from_json
from neuros.registry import Chosen

_AGAIN_S = 0.5
_OF_PARTS = ("domain_id", "peers", "peer_timeout", "duration", "output", "verbose")
_PART_OPTIONS = [each for each in options_of(Request) if each.name in _OF_PARTS]
_CODES_OF_SIGNALS = {2: 130, 15: 143, 1: 143}


def parts_to_json(project: Project, files: Sequence[NodeFile]) -> dict[str, Any]:
    """The content of ``nodes.json``: the ``node.json`` of every node, and data of the project.

    Args:
        files: with the paths of the nodes' containers.
    """
    return {
        "project": project.name,
        "file": str(files[0].folders.project / project.file.name),
        "budgets": budgets_to_json(project.budgets),
        "nodes": [node_file_to_json(file) for file in files],
    }


def parts_from_json(content: Mapping[str, Any]) -> Project:
    """The inverse of :func:`parts_to_json`; raises ``KeyError`` for anything else."""
    files = node_files_from_json(content["nodes"])
    connections = {connection for file in files for connection in file.connections}
    return Project(
        name=content["project"],
        nodes=tuple(file.node for file in files),
        connections=tuple(sorted(connections, key=lambda connection: connection.index)),
        file=Path(content["file"]),
        budgets=Budgets(**content["budgets"]),
        names=files[0].names if files else Names(),
    )


def read_parts(file: Path) -> Project:
    """The project that was exported to a file.

    Raises:
        UsageError: the file is not a project's.
    """
    try:
        return parts_from_json(json.loads(file.read_text("utf-8")))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        why = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        raise UsageError(
            f"{file}: not what `neuros export` writes as nodes.json ({why}): export the project"
            " again"
        ) from error


def part_plan(project: Project, network: Network, request: Request) -> Plan:
    """The plan of a launcher that starts one node of the project, as a process of its container.

    Raises:
        UsageError: there is no such node.
        EnvironmentFault: the node cannot run here.
    """
    known = {node.name for node in project.nodes}
    for name in request.nodes:
        if name not in known:
            raise UsageError(f"no such node: {name}; the project has {', '.join(sorted(known))}")
    # The engine or Kubernetes enforces limits, so there is no notice that the back end does not.
    chosen = Chosen(PROCESS, PROCESS.prepare(project, [], {}))
    plan = Plan(project, tuple(request.nodes), chosen, request, network=network)
    check_machine(plan, {})
    return plan


def reach_peers(peers: str | None, timeout_s: float | None, signals: Sequence[int]) -> Network:
    """The network with these peers, once all their names can be resolved.

    A container gets its name when it starts, and each may be the first to start.

    Args:
        timeout_s: seconds; ``None``: do not wait for names.
        signals: a signal that arrives here ends the wait.

    Raises:
        UsageError: a name is impossible.
        EnvironmentFault: a name cannot be resolved in time.
    """
    deadline_s = time.monotonic() + (timeout_s or 0.0)
    while True:
        try:
            return chosen_network(True, peers)
        except EnvironmentFault:
            if signals or time.monotonic() >= deadline_s:
                raise
        time.sleep(_AGAIN_S)


def add_part(part: argparse.ArgumentParser) -> None:
    part.add_argument("file", type=Path)
    part.add_argument("node")
    add_options(part, _PART_OPTIONS)
    part.set_defaults(command=_part)


def _part(parsed: argparse.Namespace) -> int:
    """Start one node of an exported project, and be a peer of the others; returns the exit code."""
    with signals_noted() as (signals, waker):
        from neuros.api.execution import Execution

        values = values_of(_PART_OPTIONS, parsed)
        request = Request(nodes=(parsed.node,), backend="process", network=True, **values)
        project = read_parts(parsed.file)
        try:
            network = reach_peers(request.peers, request.peer_timeout, signals)
        except EnvironmentFault:
            if signals:
                return _CODES_OF_SIGNALS[signals[0]]
            raise
        plan = part_plan(project, network, request)
        return int(Execution(plan, sys.stdout, signals, waker).run()["exit_code"])
