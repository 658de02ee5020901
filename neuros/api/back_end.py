"""Back ends: the choice of ``--backend``, and the launcher that each of them needs."""

from __future__ import annotations

import os
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.api.request import BACK_ENDS
from neuros.backends.docker.layout import as_here, inside
from neuros.backends.placement import Cores
from neuros.backends.process_launchers import InProcessLauncher, ProcessLauncher
from neuros.backends.reaper import Reaper
from neuros.errors import EnvironmentFault, UsageError
from neuros.ports import Launcher
from neuros.project.model import Folders, Node, NodeFile, Project
from neuros.transport.dds_profile import as_asked

if TYPE_CHECKING:
    from neuros.backends.docker.launcher import Containers

_COMMAND = (sys.executable, "-m", "neuros.cli", "node")


@dataclass(frozen=True)
class BackEnd:
    """A back end, and what the user should know of the choice: ``(severity, text)``."""

    name: str
    notices: tuple[tuple[str, str], ...] = ()
    containers: Containers | None = None

    def as_seen(self, file: NodeFile) -> NodeFile:
        """The node with all paths as it sees them itself."""
        return inside(file) if self.containers else file

    def as_here(self, text: str, folders: Folders) -> str:
        """What a node has said, with the names that its paths have on this machine."""
        return as_here(text, folders) if self.containers else text

    def record(self) -> dict[str, Any]:
        """What belongs into the record of a run: engine and images, where there are any."""
        if self.containers is None:
            return {}
        try:
            return {"docker": self.containers.record()}
        except EnvironmentFault:  # the engine has gone away, of which the run has ended
            return {"docker": None}

    def launcher(
        self,
        options: Sequence[str],
        placement: Mapping[str, Cores],
        pythons: Mapping[str, Path],
        reaper: Reaper | None = None,
    ) -> Launcher:
        """Starts nodes; ``options`` are those of the command ``node``.

        ``pythons``: of nodes that run as a process on another one than this.
        """
        if self.containers:
            from neuros.backends.docker.launcher import DockerLauncher

            watch = reaper.watch_containers if reaper else None
            return DockerLauncher(self.containers, options, watch, placement, as_asked(os.environ))
        on_started = reaper.watch if reaper else None
        if self.name == "in-process":
            return InProcessLauncher([*_COMMAND, *options, "--in-memory"], on_started, placement)
        return ProcessLauncher([*_COMMAND, *options], on_started, placement, pythons)


def choose_back_end(wanted: str, project: Project, names: Collection[str]) -> BackEnd:
    """The back end for ``--backend``.

    Raises:
        EnvironmentFault: if containers are wanted, and the engine or an image is not there.
    """
    nodes = [node for node in project.nodes if node.name in names]
    if wanted not in BACK_ENDS:
        raise UsageError(f"back end {wanted!r}: choose one of {', '.join(BACK_ENDS)}")
    if wanted in ("docker", "auto"):
        try:
            containers = _containers(project, nodes)
        except EnvironmentFault as fault:
            if wanted == "docker":
                raise
            return BackEnd("process", (_why_not(fault), *_ignored(nodes)))
        notices = [("WARN", each.notice) for each in containers.images.values() if each.notice]
        notices += [
            *_without_limits(nodes, containers.abilities.unkept),
            *_without_display(nodes, os.environ),
        ]
        return BackEnd("docker", tuple(notices), containers)
    return BackEnd(wanted, tuple(_ignored(nodes)))


def _containers(project: Project, nodes: Sequence[Node]) -> Containers:
    if find_spec("docker") is None:
        raise EnvironmentFault("the Python package docker is not installed: run install.py")
    from neuros.backends.docker.launcher import find_containers

    return find_containers(dict.fromkeys(node.container for node in nodes), project.folder)


def _without_limits(nodes: Sequence[Node], unkept: Collection[str]) -> Sequence[tuple[str, str]]:
    """One line on limits that the engine does not keep."""
    asking = [
        node.name
        for node in nodes
        if any(getattr(node.resources, limit) is not None for limit in unkept)
    ]
    if not asking:
        return ()
    return [
        (
            "WARN",
            f"resources of {', '.join(asking)}: this Docker engine has no control groups for them"
            " (docker info), so they do not hold",
        )
    ]


def _without_display(
    nodes: Sequence[Node], environ: Mapping[str, str]
) -> Sequence[tuple[str, str]]:
    """One line on nodes that ask for a display where there is none."""
    asking = [node.name for node in nodes if node.access.display]
    if not asking or environ.get("DISPLAY"):
        return ()
    return [("WARN", f"{', '.join(asking)} asks for a display, and DISPLAY is not set: no windows")]


def _why_not(fault: EnvironmentFault) -> tuple[str, str]:
    """One line on why ``auto`` is not docker."""
    reason, *others = str(fault).splitlines()
    reason = reason.removesuffix(", or run without containers: --backend process")
    more = f" (and {len(others)} more)" if others else ""
    return "INFO", f"each node runs in a process, not in a container: {reason}{more}"


def _ignored(nodes: Sequence[Node]) -> Sequence[tuple[str, str]]:
    """One line on limits that this back end does not enforce."""
    limited = [node.name for node in nodes if any(vars(node.resources).values())]
    if not limited:
        return ()
    return [("INFO", f"resources of {', '.join(limited)}: only --backend docker keeps to them")]
