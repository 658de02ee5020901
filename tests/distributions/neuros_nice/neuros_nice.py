"""A back end of another distribution: a process per node, at a lower priority."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from neuros.backends.node_command import node_process
from neuros.errors import EnvironmentFault
from neuros.options import Option
from neuros.ports import (
    BackEnd,
    ChildProcess,
    Deployment,
    Finding,
    Launcher,
    NodeProgram,
    RunningNode,
)
from neuros.project.model import Node, NodeFile, Project
from neuros.stacks import ProcessThreads, threads_of


class Nice(BackEnd):
    """Starts nodes with nice(1)."""

    name = "nice"
    place = "a process of low priority"
    options = (
        Option(
            ("--nice-level",), "how much lower, 1 to 19", default=10, parse=int, metavar="LEVEL"
        ),
    )

    def prepare(
        self, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
    ) -> Deployment:
        if shutil.which("nice") is None:
            raise EnvironmentFault("nice(1) is not on PATH: apt-get install coreutils")
        if not 1 <= options["nice_level"] <= 19:
            raise EnvironmentFault(f"--nice-level {options['nice_level']}: give 1 to 19")
        return NiceProcesses(options["nice_level"])

    def checks(self, environ: Mapping[str, str]) -> Iterator[Finding]:
        program = shutil.which("nice", path=environ.get("PATH"))
        yield Finding.good("nice", program) if program else Finding.absent("nice", "not on PATH")


class NiceProcesses(Deployment):
    """Nodes at one level."""

    def __init__(self, level: int) -> None:
        self._level = level
        self.notices = [("INFO", f"nodes have the nice level {level}")]

    def launcher(self, program: NodeProgram) -> Launcher:
        return NiceLauncher(program, self._level)

    def record(self) -> Mapping[str, Any]:
        return {"nice": {"level": self._level}}


class NiceLauncher:
    """Starts them."""

    def __init__(self, program: NodeProgram, level: int) -> None:
        self._program = program
        self._prefix = ["nice", "-n", str(level)]

    def start(
        self, nodes: Sequence[NodeFile], environment: Mapping[str, str]
    ) -> Sequence[RunningNode]:
        started: list[NiceNode] = []
        for node in nodes:
            process = node_process(self._program, node, environment)
            assert self._program.guardian is not None
            child = self._program.guardian.spawn(
                [*self._prefix, *process.command],
                process.log,
                process.folder,
                process.environment,
            )
            started.append(NiceNode(node.node.name, child))
        return started

    def describe(self, nodes: Sequence[NodeFile]) -> Sequence[str]:
        return [f"{' '.join(self._prefix)} {node_process(self._program, n, {})}" for n in nodes]


class NiceNode:
    """One that runs (:class:`neuros.ports.RunningNode`)."""

    is_abandoned = False

    def __init__(self, name: str, child: ChildProcess) -> None:
        self.names = (name,)
        self._child = child

    def poll(self) -> str | None:
        code = self._child.poll()
        return None if code is None else f"exit code {code}"

    def threads(self) -> ProcessThreads:
        return threads_of(self._child.pid)

    def kill(self) -> None:
        self._child.send_signal(signal.SIGKILL, is_for_group=True)


BACK_END = Nice()
