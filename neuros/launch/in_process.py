"""The in-process back end: one host process with all nodes of the project in it."""

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
    start_environment,
    with_messages,
)
from neuros.launch.placement import Cores, on_cores, thread_limits
from neuros.project.model import NodeFile


class InProcessLauncher:
    """Starts one host for all nodes (:class:`neuros.ports.Launcher`).

    The host gives each node its own environment and its own log; what does not come from a node
    goes to ``host.log`` in the run folder.

    Args:
        command: the host program; the paths of all ``node.json`` files are appended to it.
        on_started: called with the process id of the host as soon as it exists.
        placement: the cores of nodes, by name; the host gets those of all of them.
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
    ) -> Sequence[HostProcess]:
        """Start the host. Raises ``EnvironmentFault``."""
        if not nodes:
            return []
        limits = thread_limits([node.node for node in nodes]) if self._cores else {}
        host = HostProcess(
            [node.node.name for node in nodes],
            host_arguments(self._command, nodes),
            log=host_log(nodes),
            folder=nodes[0].folders.run,
            environment=start_environment(
                self._command,
                nodes,
                with_messages(
                    host_environment(os.environ, {**limits, **environment}), nodes[0].messages
                ),
            ),
            cores=self._cores or None,
        )
        try:
            if self._on_started:
                self._on_started(host.pid)
        except BaseException:
            end_now([host])
            raise
        return [host]

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        """One line."""
        if not nodes:
            return []
        names = ", ".join(node.node.name for node in nodes)
        command = shlex.join(host_command(self._command, nodes))
        where = on_cores(self._cores)
        return [f"one process for {names}{where}: {command} (log: {host_log(nodes)})"]


def host_log(nodes: Sequence[NodeFile]) -> Path:
    """Where the output of the host goes."""
    return nodes[0].folders.run / "host.log"
