"""The process back end: one host process per node."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from neuros.launch.host import HostProcess, end_now
from neuros.launch.host_command import (
    host_arguments,
    host_command,
    host_environment,
    log_file,
    node_environment,
    start_environment,
    with_messages,
)
from neuros.launch.placement import Cores, on_cores, thread_limits
from neuros.project.model import NodeFile


class ProcessLauncher:
    """Starts one host per node (:class:`neuros.ports.Launcher`).

    Args:
        command: the host program; the paths of ``node.json`` files are appended to it.
        on_started: called with the process id of each host as soon as it exists.
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
    ) -> Sequence[HostProcess]:
        """Start a host per node, all or none. Raises ``EnvironmentFault``."""
        hosts: list[HostProcess] = []
        try:
            for node in nodes:
                host = self._host(node, environment)
                hosts.append(host)
                if self._on_started:
                    self._on_started(host.pid)
        except BaseException:
            end_now(hosts)
            raise
        return hosts

    def _host(self, node: NodeFile, environment: Mapping[str, str]) -> HostProcess:
        cores = self._placement.get(node.node.name)
        limits = thread_limits([node.node]) if cores else {}
        added = {**limits, **node_environment(node), **environment}
        command = self._command_of(node)
        return HostProcess(
            [node.node.name],
            host_arguments(command, [node]),
            log=log_file(node),
            folder=node.folders.run,
            environment=start_environment(
                command,
                [node],
                with_messages(host_environment(os.environ, added), node.messages),
            ),
            cores=cores,
        )

    def _command_of(self, node: NodeFile) -> Sequence[str]:
        python = self._pythons.get(node.node.name)
        return (str(python), *self._command[1:]) if python else self._command

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        """One line per host."""
        return [
            f"process {node.node.name}{on_cores(self._placement.get(node.node.name))}:"
            f" {shlex.join(host_command(self._command_of(node), [node]))} (log: {log_file(node)})"
            for node in nodes
        ]
