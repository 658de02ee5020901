"""Viewers in windows: rqt_graph and rviz2 of a ROS distribution, where there is a display."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from neuros.backends.docker.tool import ToolContainer, find_tool_image
from neuros.backends.sidecars import start_sidecar
from neuros.errors import EnvironmentFault
from neuros.ports import BackEnd, Reaper, Shown, Viewer
from neuros.viewers.rviz import rviz_configuration

RVIZ_FILE = "project.rviz"
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


class _Window:
    """A tool on a run."""

    def __init__(self, tool: Tool, arguments: Callable[[Shown], Sequence[str]]) -> None:
        self._tool = tool
        self._arguments = arguments
        self._running: ToolProcess | ToolContainer | None = None

    def start(self, run: Shown, reaper: Reaper) -> str:
        self._running = self._tool.start(self._arguments(run), run.folder, run.environment)
        self._running.announce(reaper)
        return f"{self._tool.program}: a window on this display"

    def finish(self) -> None:
        if self._running is not None:
            self._running.finish()


class _ToolViewer(Viewer):
    def __init__(
        self, name: str, ranks: Mapping[str, int], arguments: Callable[[Shown], Sequence[str]]
    ) -> None:
        self.name = self.place = name
        self.ranks = ranks
        self._arguments = arguments

    def prepare(self, back_end: BackEnd, subject: str | None, port: int | None) -> _Window:
        if back_end.is_one_process:
            raise EnvironmentFault(
                "nodes of one process talk past ROS, where its tools see nothing"
            )
        return _Window(find_tool(self.name), self._arguments)


def _configured(run: Shown) -> Sequence[str]:
    path = run.folder / RVIZ_FILE
    path.write_text(rviz_configuration(run.project), "utf-8")
    return ["-d", str(path)]


RQT_GRAPH = _ToolViewer("rqt_graph", {"graph": 1}, lambda _: [])
RVIZ = _ToolViewer("rviz2", {"packets": 1}, _configured)


def has_display(environ: Mapping[str, str] = os.environ) -> bool:
    """Whether windows can be opened."""
    return bool(environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY"))


def open_page(url: str) -> None:
    """Open a page in a browser where there is a display; its address is printed in any case."""
    import webbrowser

    if has_display():
        webbrowser.open(url)


def find_tool(program: str, environ: Mapping[str, str] = os.environ) -> Tool:
    """The tool. Raises ``EnvironmentFault``: in a few words why it cannot run here."""
    if not has_display(environ):
        raise EnvironmentFault(f"{program} needs a display")
    path = shutil.which(program, path=environ.get("PATH"))
    if path is None and (reason := find_tool_image(environ)):
        raise EnvironmentFault(f"{program} is not on PATH, and {reason}")
    return Tool(program, path)
