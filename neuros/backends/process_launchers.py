"""The back ends ``process`` and ``in-process``: a node process per node, or one for all.

A node process leads a session of its own, so that Ctrl+C reaches only the launcher, and writes its
log itself, so that nothing passes through the launcher and nothing is lost when that dies.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from neuros.backends.guardian import UNKNOWN
from neuros.backends.node_command import (
    PROCESS_LOG,
    NodeProcess,
    common_process,
    node_process,
    script_failure,
    signal_in_words,
)
from neuros.errors import EnvironmentFault
from neuros.options import Option
from neuros.ports import BackEnd, Deployment, Guardian, Launcher, NodeProgram
from neuros.project.model import Node, NodeFile, Project
from neuros.stacks import ProcessThreads, threads_of

WITHOUT_ROS = "local"
"""The transport of nodes of one process that no ROS tool finds."""

VIRTUAL_ROS = "virtual-ros"
"""The transport of nodes in processes or containers of their own, in virtual time."""


class ProcessBackEnd(BackEnd):
    """A process per node; the last choice of ``auto``."""

    name = "process"
    place = "a process"
    rank = 0
    is_forked = True

    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        return ProcessDeployment(nodes)


class InProcessBackEnd(BackEnd):
    """One process for all nodes; only by request."""

    name = "in-process"
    place = "one process with all others"
    transport = "memory"
    is_one_process = is_forked = True
    options = (
        Option(
            ("--no-ros",),
            "leave ROS out: no topics for ROS tools; ROS starts only if a plugin or an external"
            " topic needs it",
            default=True,
            page="back_ends.md#without-ros",
        ),
    )

    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        return InProcessDeployment(nodes, "" if options["ros"] else WITHOUT_ROS)


ProcessOf: TypeAlias = "Callable[[NodeProgram, NodeFile, Mapping[str, str]], NodeProcess]"

PROCESS = ProcessBackEnd()
IN_PROCESS = InProcessBackEnd()


class ProcessDeployment(Deployment):
    """Processes of this machine, without limits of resources."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        limited = [node.name for node in nodes if any(vars(node.resources).values())]
        if limited:
            text = f"resources of {', '.join(limited)}: only --backend docker keeps to them"
            self.notices = [("INFO", text)]

    def launcher(self, program: NodeProgram) -> Launcher:
        return ProcessLauncher(program)


class InProcessDeployment(ProcessDeployment):
    """One process of this machine for all nodes."""

    def __init__(self, nodes: Sequence[Node], transport: str) -> None:
        super().__init__(nodes)
        self.transport = transport

    def launcher(self, program: NodeProgram) -> Launcher:
        return InProcessLauncher(program)

    def logs(self, run_folder: Path) -> Mapping[str, Path]:
        return {"host": run_folder / PROCESS_LOG}


class ProcessLauncher:
    """Starts one node process per node (:class:`neuros.ports.Launcher`).

    Args:
        process_of: the process of a node in the environment of the run.
    """

    def __init__(self, program: NodeProgram, process_of: ProcessOf = node_process) -> None:
        self._program = program
        self._process_of = process_of

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[RunningProcess]:
        started: list[RunningProcess] = []
        try:
            for process in self._processes(nodes, environment):
                assert self._program.guardian is not None
                started.append(RunningProcess(process, self._program.guardian))
        except BaseException:
            end_now(started)
            raise
        return started

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        return [str(process) for process in self._processes(nodes, {})]

    def _processes(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[NodeProcess]:
        return [self._process_of(self._program, node, environment) for node in nodes]


class InProcessLauncher(ProcessLauncher):
    """Starts one node process for all nodes.

    It gives each node its own environment and its own log; other output goes to ``host.log`` in
    the run folder.
    """

    def _processes(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[NodeProcess]:
        return [common_process(self._program, nodes, environment)] if nodes else []


class RunningProcess:
    """A node process that was started, and the nodes in it (:class:`neuros.ports.RunningNode`).

    Attributes:
        pid: its process id, which is also that of its process group and session.
    """

    is_abandoned = False

    def __init__(self, process: NodeProcess, guardian: Guardian) -> None:
        """Start the process. Raises ``EnvironmentFault``."""
        self.names = process.names
        self._log = process.log
        try:
            process.log.parent.mkdir(parents=True, exist_ok=True)
            self._process = guardian.spawn(
                process.command, process.log, process.folder, process.environment, process.cores
            )
        except OSError as error:
            nodes = ", ".join(self.names)
            raise EnvironmentFault(f"cannot start the process of {nodes}: {error}") from error
        self.pid = self._process.pid

    def poll(self) -> str | None:
        code = self._process.poll()
        if code is None:
            return None
        if code == UNKNOWN:
            return "how is not known, since the guardian was killed"
        if code < 0:
            return signal_in_words(-code)
        return (script_failure(self._log) if code == 1 else None) or f"exit code {code}"

    def wait(self, timeout_s: float) -> str | None:
        """Wait for its end, at most ``timeout_s`` seconds; returns as :meth:`poll`."""
        self._process.wait(timeout_s)
        return self.poll()

    def terminate(self) -> None:
        """Ask it to end (SIGTERM)."""
        self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self._process.send_signal(signal.SIGKILL, is_for_group=True)

    def threads(self) -> ProcessThreads:
        read = threads_of(self.pid)
        return read if self.poll() is None else ProcessThreads()


def end_now(processes: Sequence[RunningProcess]) -> None:
    """Kill processes and wait until they are gone."""
    for process in processes:
        process.kill()
    for process in processes:
        process.wait(5.0)
