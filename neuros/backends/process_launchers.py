"""The back ends ``process`` and ``in-process``: a node process per node, or one for all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.backends.child_processes import RunningProcess, end_now
from neuros.backends.node_command import PROCESS_LOG, NodeProcess, common_process, node_process
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
    transport = "memory"
    is_one_process = True

    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        return _OneProcess(nodes)


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
        return ProcessLauncher(program)


class _OneProcess(_Processes):
    def launcher(self, program: NodeProgram) -> Launcher:
        return InProcessLauncher(program)

    def logs(self, run_folder: Path) -> Mapping[str, Path]:
        return {"host": run_folder / PROCESS_LOG}


class ProcessLauncher:
    """Starts one node process per node (:class:`neuros.ports.Launcher`)."""

    def __init__(self, program: NodeProgram) -> None:
        self._program = program

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[RunningProcess]:
        """Start the processes, all or none. Raises ``EnvironmentFault``."""
        started: list[RunningProcess] = []
        try:
            for process in self._processes(nodes, environment):
                started.append(RunningProcess(process))
                if self._program.reaper:
                    self._program.reaper.watch(started[-1].pid)
        except BaseException:
            end_now(started)
            raise
        return started

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        """One line per process."""
        return [str(process) for process in self._processes(nodes, {})]

    def _processes(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[NodeProcess]:
        return [node_process(self._program, node, environment) for node in nodes]


class InProcessLauncher(ProcessLauncher):
    """Starts one node process for all nodes.

    It gives each node its own environment and its own log; what does not come from a node
    goes to ``host.log`` in the run folder.
    """

    def _processes(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[NodeProcess]:
        return [common_process(self._program, nodes, environment)] if nodes else []
