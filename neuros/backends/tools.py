"""Graphical tools of a ROS distribution: rqt_graph, rviz2. They run where there is a display."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from neuros.backends.docker.tool import ToolContainer, find_tool_image
from neuros.backends.reaper import Reaper
from neuros.backends.sidecars import start_sidecar

_END_S = 2.0
_MOST_WAIT_S = 5.0


@dataclass(frozen=True)
class Tool:
    """A tool that can run here.

    Attributes:
        program: its name.
        path: where it is, ``None``: in the image ``neuros_tools``.
    """

    program: str
    path: str | None

    def start(
        self, arguments: Sequence[str], run: Path, environment: Mapping[str, str]
    ) -> ToolProcess | ToolContainer:
        """Start it with the environment of a run. Raises ``EnvironmentFault``."""
        if self.path is None:
            return ToolContainer(self.program, arguments, run, environment)
        command = [self.path, *arguments]
        log = run / f"{self.program}.log"
        return ToolProcess(
            start_sidecar(self.program, command, run, log, environment, is_ours=False)
        )


class ToolProcess:
    """A tool that runs as a process of this machine."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    def announce(self, reaper: Reaper) -> None:
        """Have it ended if the launcher is killed."""
        reaper.watch(self._process.pid)

    def finish(self) -> None:
        """End it with the run."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.terminate()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(_MOST_WAIT_S)


def has_display(environ: Mapping[str, str] = os.environ) -> bool:
    """Whether windows can be opened."""
    return bool(environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY"))


def find_tool(program: str, environ: Mapping[str, str] = os.environ) -> Tool | str:
    """The tool, or in a few words why it cannot run here."""
    if not has_display(environ):
        return f"{program} needs a display"
    path = shutil.which(program, path=environ.get("PATH"))
    if path is not None:
        return Tool(program, path)
    reason = find_tool_image(environ)
    return Tool(program, None) if reason is None else f"{program} is not on PATH, and {reason}"
