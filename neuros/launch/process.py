"""The process back end: one host process per node."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

from neuros.launch.host import HostProcess, end_now
from neuros.launch.host_command import (
    host_arguments,
    host_command,
    host_environment,
    log_file,
    node_environment,
    start_environment,
)
from neuros.launch.placement import Cores, on_cores, thread_limits
from neuros.project.model import NodeFile


class ProcessLauncher:
    """Starts one host per node (:class:`neuros.ports.Launcher`).

    Args:
        command: the host program; the paths of ``node.json`` files are appended to it.
        on_started: called with the process id of each host as soon as it exists.
        placement: the cores of each node, by name; the kernel places those that are not in it.
    """

    def __init__(
        self,
        command: Sequence[str],
        on_started: Callable[[int], None] | None = None,
        placement: Mapping[str, Cores] = MappingProxyType({}),
    ) -> None:
        self._command = tuple(command)
        self._on_started = on_started
        self._placement = placement

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
        return HostProcess(
            [node.node.name],
            host_arguments(self._command, [node]),
            log=log_file(node),
            folder=node.folders.run,
            environment=start_environment(
                self._command, [node], host_environment(os.environ, added)
            ),
            cores=cores,
        )

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        """One line per host."""
        return [
            f"process {node.node.name}{on_cores(self._placement.get(node.node.name))}:"
            f" {shlex.join(host_command(self._command, [node]))} (log: {log_file(node)})"
            for node in nodes
        ]
