"""Viewers of a run: ``--dashboard``, ``--node-graph``, ``--visualisations``, their programs."""

from __future__ import annotations

import argparse
import json
import os
import select
import socket
import sys
import time
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from neuros.errors import EnvironmentFault

if TYPE_CHECKING:
    from neuros.api.execution import Shown
    from neuros.api.plan import Plan
    from neuros.api.request import LaunchOptions
    from neuros.backends.reaper import Reaper
    from neuros.backends.sidecars import DashboardProcess, RerunProcesses
    from neuros.backends.tools import Tool
    from neuros.viewers.dashboard.server import Sources

RVIZ_FILE = "project.rviz"
_LAST_LOG_BYTES = 1 << 16


class Closable(Protocol):
    """Something that shows a run, and is closed with it."""

    def finish(self) -> None: ...


class Views:
    """What the command line asks to be shown of a run.

    Raises:
        UsageError: if the port of the dashboard is taken.
        EnvironmentFault: if visualisations cannot be shown in any way.
    """

    def __init__(self, options: LaunchOptions, plan: Plan) -> None:
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
        self._dashboard: DashboardProcess | None = None
        if options.dashboard or options.dashboard_port is not None or self._opens_graph:
            from neuros.backends.sidecars import DashboardProcess

            self._dashboard = DashboardProcess(options.dashboard_port or 0)

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
            reaper.watch(self._start_dashboard(self._dashboard, run))
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
        from neuros.backends.sidecars import RerunProcesses

        if find_spec("rerun") is None:
            raise EnvironmentFault(
                f"--visualisations: {reason}, and Rerun is not installed: ./install.py --extras"
                " rerun, or pip install 'neuros[rerun]'"
            )
        self._rerun = RerunProcesses()
        self._notices.append(f"--visualisations: in Rerun, since {reason}")

    def _start_dashboard(self, dashboard: DashboardProcess, run: Shown) -> int:
        """Start the process that serves it; returns its id."""
        from neuros.viewers.project_view import project_view

        return dashboard.start(
            [sys.executable, "-m", "neuros.cli", "dashboard", str(run.folder)],
            run.folder,
            run.environment,
            {
                "run": run.run_id,
                "plan": project_view(self._plan.project, self._plan.names),
                "names": self._plan.names,
                "logs": {name: str(path) for name, path in run.logs.items()},
                "is_one_process": self._plan.back_end.is_one_process,
                "start_s": time.monotonic(),
            },
        )

    def _start_rerun(self, rerun: RerunProcesses, run: Shown, reaper: Reaper) -> None:
        from neuros.viewers.project_view import project_view

        sources = project_view(self._plan.project, self._plan.names)["sources"]
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


def add_view(view: argparse.ArgumentParser) -> None:
    """Program that feeds Rerun; ``launch`` starts it, not people."""
    view.add_argument("run")
    view.set_defaults(command=_run_view)


def _run_view(_: argparse.Namespace) -> int:
    from neuros.backends.control_sockets import connect_by
    from neuros.backends.sidecars import await_server
    from neuros.control import TO_OBSERVERS
    from neuros.control.link import ControlLink
    from neuros.viewers.rerun_feed import RerunFeed
    from neuros.viewers.visual_types import VisualTypes, look_on

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
    link = ControlLink(connect_by(os.environ), TO_OBSERVERS, "the supervisor")
    look_on(link, sources, feed.show)
    feed.close()
    return 0


def add_dashboard(dashboard: argparse.ArgumentParser) -> None:
    """Program that serves the dashboard; ``launch`` starts it, not people."""
    dashboard.add_argument("run")
    dashboard.set_defaults(command=_run_dashboard)


def _run_dashboard(_: argparse.Namespace) -> int:
    told = json.loads(sys.stdin.readline())
    listening = socket.socket(fileno=told["descriptor"])
    if not _is_looked_at(listening):
        return 0
    # Loading all this takes a fifth of a second of a core that the nodes can use.
    import asyncio

    asyncio.run(_serve(told, listening))
    return 0


async def _serve(told: Mapping[str, Any], listening: socket.socket) -> None:
    from neuros.backends.control_sockets import connect_by
    from neuros.control import TO_OBSERVERS
    from neuros.control.link import ControlLink
    from neuros.viewers.dashboard.live_metrics import LiveRun
    from neuros.viewers.dashboard.pages import Pages
    from neuros.viewers.dashboard.server import Dashboard

    names, pages = tuple(told["names"]), Pages()
    link = ControlLink(connect_by(os.environ), TO_OBSERVERS, "the supervisor")
    run = LiveRun(pages, link, names, told["start_s"])
    dashboard = Dashboard(told["plan"], _sources(told, names), pages, run)
    await dashboard.serve(listening, told["token"], told["run"])


def _is_looked_at(listening: socket.socket) -> bool:
    """Wait until a browser opens the page; False if the run ends before."""
    readable, _, _ = select.select([listening, sys.stdin], [], [])
    return listening in readable


def _sources(told: Mapping[str, Any], names: tuple[str, ...]) -> Sources:
    from neuros.api.observation import owner_of_processes
    from neuros.recording.system_load import LAUNCHER, LoadMeter, LoadNow
    from neuros.viewers.dashboard.server import Sources

    owner = owner_of_processes(told["run"], names, is_one_process=told["is_one_process"])
    load_now = LoadNow(LoadMeter(owner))
    logs = {name: Path(path) for name, path in told["logs"].items()}

    def load() -> Mapping[str, Any]:
        load = load_now()
        # What is not a node's is this process.
        load["groups"]["dashboard"] = load["groups"].pop(LAUNCHER)
        return load

    return Sources(lambda: _Log(logs), load)


class _Log:
    """The new lines of the logs of a run, as the console shows them."""

    def __init__(self, files: Mapping[str, Path]) -> None:
        from neuros.backends.console import LogTail

        self._lines: list[str] = []
        self._tail = LogTail(files, self._take, colours=False, last_bytes=_LAST_LOG_BYTES)

    def read(self) -> list[str]:
        self._tail.poll()
        lines, self._lines = self._lines, []
        return lines

    def close(self) -> None:
        self._tail.close()

    def _take(self, text: str) -> None:
        self._lines += text.splitlines()
