"""``--node-graph`` and ``--visualisations``: viewers of a run, the best that this machine has."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from neuros.cli.dashboard import dashboard_of, start_dashboard
from neuros.errors import EnvironmentFault

if TYPE_CHECKING:
    from neuros.api.execution import Shown
    from neuros.api.plan import Plan
    from neuros.backends.reaper import Reaper
    from neuros.backends.rerun import RerunProcesses
    from neuros.backends.tools import Tool

RVIZ_FILE = "project.rviz"


def add_view_options(launch: argparse.ArgumentParser) -> None:
    """Add the options of ``neuros launch``."""
    launch.add_argument(
        "-g",
        "--node-graph",
        action="store_true",
        help="show the graph of the run: rqt_graph where it can run, else the dashboard",
    )
    launch.add_argument(
        "-z",
        "--visualisations",
        action="store_true",
        help="show poses, images, scans and numbers: rviz2 where it can run, else Rerun in a"
        " browser (pip install 'neuros[rerun]')",
    )


def add_view(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The program that feeds Rerun; ``launch`` starts it, not people."""
    view = commands.add_parser("view", add_help=False)
    view.add_argument("run")
    view.set_defaults(command=_run_view)


class Closable(Protocol):
    """Something that shows a run, and is closed with it."""

    def finish(self) -> None: ...


class Views:
    """What the command line asks to be shown of a run.

    Raises:
        UsageError: if the port of the dashboard is taken.
        EnvironmentFault: if visualisations cannot be shown in any way.
    """

    def __init__(self, options: argparse.Namespace, plan: Plan) -> None:
        self._plan = plan
        self._tools: list[Tool] = []
        self._rerun: RerunProcesses | None = None
        self._notices: list[str] = []
        self._running: list[Closable] = []
        self._opens_graph = False
        if options.node_graph:
            reason = self._take_tool("rqt_graph")
            if reason is not None:
                self._opens_graph = True
                self._notices.append(f"--node-graph: in the dashboard, since {reason}")
        if options.visualisations:
            reason = self._take_tool("rviz2")
            if reason is not None:
                self._take_rerun(reason)
        self._dashboard = dashboard_of(options, is_wanted=self._opens_graph)

    def start(self, run: Shown, reaper: Reaper, log: Callable[[str, str], None]) -> None:
        """Open windows and pages, once there is a control socket. Raises ``EnvironmentFault``."""
        for notice in self._notices:
            log("INFO", notice)
        for tool in self._tools:
            arguments = [] if tool.program == "rqt_graph" else ["-d", self._write_rviz(run.folder)]
            running = tool.start(arguments, run.folder, run.environment)
            self._running.append(running)
            running.announce(reaper)
            log("INFO", f"{tool.program}: a window on this display")
        if self._dashboard is not None:
            self._running.append(self._dashboard)
            reaper.watch(
                start_dashboard(
                    self._dashboard,
                    self._plan,
                    run.run_id,
                    run.folder,
                    run.logs,
                    run.environment,
                )
            )
            log("INFO", f"dashboard: {self._dashboard.url}")
            if self._opens_graph:
                _open(f"{self._dashboard.url}#graph-section")
        if self._rerun is not None:
            self._start_rerun(self._rerun, run, reaper)
            log("INFO", f"visualisations: {self._rerun.url}")

    def finish(self) -> None:
        """Close what was opened."""
        for running in self._running:
            running.finish()

    def _take_tool(self, program: str) -> str | None:
        """Have a tool started later, or say in a few words why it cannot be."""
        from neuros.backends.tools import find_tool

        if self._plan.back_end.is_one_process:
            return "nodes of one process talk past ROS, where its tools see nothing"
        found = find_tool(program)
        if isinstance(found, str):
            return found
        self._tools.append(found)
        return None

    def _take_rerun(self, reason: str) -> None:
        from neuros.backends.rerun import RerunProcesses

        if find_spec("rerun") is None:
            raise EnvironmentFault(
                f"--visualisations: {reason}, and Rerun is not installed: ./install.py --extras"
                " rerun, or pip install 'neuros[rerun]'"
            )
        self._rerun = RerunProcesses()
        self._notices.append(f"--visualisations: in Rerun, since {reason}")

    def _start_rerun(self, rerun: RerunProcesses, run: Shown, reaper: Reaper) -> None:
        from neuros.viewers.dashboard.plan import plan as shown_plan

        sources = shown_plan(self._plan.project, self._plan.names)["sources"]
        command = [sys.executable, "-m", "neuros.cli", "view", str(run.folder)]
        told = {"project": self._plan.project.name, "sources": sources}
        self._running.append(rerun)
        for pid in rerun.start(command, run.folder, run.environment, told):
            reaper.watch(pid)

    def _write_rviz(self, folder: Path) -> str:
        from neuros.viewers.rviz import rviz_configuration

        path = folder / RVIZ_FILE
        path.write_text(rviz_configuration(self._plan.project), "utf-8")
        return str(path)


def _open(url: str) -> None:
    """Open a page where there is a display; its address is printed in any case."""
    import webbrowser

    from neuros.backends.tools import has_display

    if has_display():
        webbrowser.open(url)


def _run_view(options: argparse.Namespace) -> int:
    from neuros.backends.rerun import await_server
    from neuros.viewers.observer import look_on
    from neuros.viewers.rerun_feed import RerunFeed
    from neuros.viewers.visual_types import VisualTypes

    told = json.loads(sys.stdin.readline())
    sources = {
        each["name"]: (each["node"], each["port"], VisualTypes(each["type"]))
        for each in told["sources"]
    }
    await_server(told["url"])
    _open(told["url"])
    feed = RerunFeed(
        told["project"], told["feed_url"], {name: source for name, (*_, source) in sources.items()}
    )
    look_on(Path(options.run), sources, feed.show)
    feed.close()
    return 0
