"""The back ends ``process`` and ``in-process``: a node process per node, or one for all."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

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
from neuros.ports import BackEnd, Deployment, Launcher, NodeProgram
from neuros.project.model import Node, NodeFile, Project


class Processes(BackEnd):
    """A process per node; what ``auto`` takes where nothing better is usable."""

    name = "process"
    place = "a process"
    rank = 0

    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        return _Processes(nodes)


class OneProcess(BackEnd):
    """One process for all nodes; it runs where somebody asks for it."""

    name = "in-process"
    place = "one process with all others"
    is_one_process = True

    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        return _OneProcess(nodes)


PROCESS_LOG = "host.log"
"""What one process for all nodes prints that comes from none of them."""

PROCESS = Processes()
IN_PROCESS = OneProcess()


class _Processes(Deployment):
    """Processes of this machine, which keep to no limits."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        limited = [node.name for node in nodes if any(vars(node.resources).values())]
        if limited:
            text = f"resources of {', '.join(limited)}: only --backend docker keeps to them"
            self.notices = [("INFO", text)]

    def launcher(self, program: NodeProgram) -> Launcher:
        watch = program.reaper.watch if program.reaper else None
        return ProcessLauncher(program.command, watch, program.cores, program.pythons)


class _OneProcess(_Processes):
    def launcher(self, program: NodeProgram) -> Launcher:
        watch = program.reaper.watch if program.reaper else None
        return InProcessLauncher(program.command, watch, program.cores)

    def logs(self, run_folder: Path) -> Mapping[str, Path]:
        return {"host": run_folder / PROCESS_LOG}


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
            log=nodes[0].folders.run / PROCESS_LOG,
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
        log = nodes[0].folders.run / PROCESS_LOG
        return [f"one process for {names}{where}: {command} (log: {log})"]
