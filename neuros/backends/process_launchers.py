"""Process back ends: one node process per node, or one for all nodes."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from neuros.backends.child_processes import RunningProcess, end_now
from neuros.backends.node_command import (
    log_file,
    node_command,
    node_environment,
    process_environment,
    start_arguments,
    start_environment,
    with_messages,
)
from neuros.backends.placement import Cores, on_cores, thread_limits
from neuros.project.model import NodeFile


class ProcessLauncher:
    """Starts one node process per node (:class:`neuros.ports.Launcher`).

    Args:
        command: the node program; the paths of ``node.json`` files are appended to it.
        on_started: called with each process id as soon as it exists.
        placement: the cores of each node, by name; the kernel places those that are not in it.
        pythons: the Python of each node that does not run on the one of ``command``, by name.
    """

    def __init__(
        self,
        command: Sequence[str],
        on_started: Callable[[int], None] | None = None,
        placement: Mapping[str, Cores] = MappingProxyType({}),
        pythons: Mapping[str, Path] = MappingProxyType({}),
    ) -> None:
        self._command = tuple(command)
        self._on_started = on_started
        self._placement = placement
        self._pythons = pythons

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[RunningProcess]:
        """Start a process per node, all or none. Raises ``EnvironmentFault``."""
        processes: list[RunningProcess] = []
        try:
            for node in nodes:
                process = self._start(node, environment)
                processes.append(process)
                if self._on_started:
                    self._on_started(process.pid)
        except BaseException:
            end_now(processes)
            raise
        return processes

    def _start(self, node: NodeFile, environment: Mapping[str, str]) -> RunningProcess:
        cores = self._placement.get(node.node.name)
        limits = thread_limits([node.node]) if cores else {}
        added = {**limits, **node_environment(node), **environment}
        command = self._command_of(node)
        return RunningProcess(
            [node.node.name],
            start_arguments(command, [node]),
            log=log_file(node),
            folder=node.folders.run,
            environment=start_environment(
                command,
                [node],
                with_messages(process_environment(os.environ, added), node.messages),
            ),
            cores=cores,
        )

    def _command_of(self, node: NodeFile) -> Sequence[str]:
        python = self._pythons.get(node.node.name)
        return (str(python), *self._command[1:]) if python else self._command

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        """One line per process."""
        return [
            f"process {node.node.name}{on_cores(self._placement.get(node.node.name))}:"
            f" {shlex.join(node_command(self._command_of(node), [node]))} (log: {log_file(node)})"
            for node in nodes
        ]


class InProcessLauncher:
    """Starts one node process for all nodes (:class:`neuros.ports.Launcher`).

    It gives each node its own environment and its own log; what does not come from a node
    goes to ``host.log`` in the run folder.

    Args:
        command: the node program; the paths of all ``node.json`` files are appended to it.
        on_started: called with the process id as soon as it exists.
        placement: the cores of nodes, by name; the process gets those of all of them.
    """

    def __init__(
        self,
        command: Sequence[str],
        on_started: Callable[[int], None] | None = None,
        placement: Mapping[str, Cores] = MappingProxyType({}),
    ) -> None:
        self._command = tuple(command)
        self._on_started = on_started
        self._cores = tuple(sorted({core for cores in placement.values() for core in cores}))

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[RunningProcess]:
        """Start the process. Raises ``EnvironmentFault``."""
        if not nodes:
            return []
        limits = thread_limits([node.node for node in nodes]) if self._cores else {}
        process = RunningProcess(
            [node.node.name for node in nodes],
            start_arguments(self._command, nodes),
            log=process_log(nodes),
            folder=nodes[0].folders.run,
            environment=start_environment(
                self._command,
                nodes,
                with_messages(
                    process_environment(os.environ, {**limits, **environment}), nodes[0].messages
                ),
            ),
            cores=self._cores or None,
        )
        try:
            if self._on_started:
                self._on_started(process.pid)
        except BaseException:
            end_now([process])
            raise
        return [process]

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        """One line."""
        if not nodes:
            return []
        names = ", ".join(node.node.name for node in nodes)
        command = shlex.join(node_command(self._command, nodes))
        where = on_cores(self._cores)
        return [f"one process for {names}{where}: {command} (log: {process_log(nodes)})"]


def process_log(nodes: Sequence[NodeFile]) -> Path:
    """The file for the output of the process."""
    return nodes[0].folders.run / "host.log"
