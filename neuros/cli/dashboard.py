"""``--dashboard``: its options, and the program of the process that serves it."""

from __future__ import annotations

import argparse
import json
import select
import socket
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuros.api.plan import Plan
    from neuros.backends.dashboard import DashboardProcess
    from neuros.viewers.dashboard.server import Sources

_LAST_LOG_BYTES = 1 << 16


def add_dashboard_options(launch: argparse.ArgumentParser) -> None:
    """Add the options of ``neuros launch``."""
    launch.add_argument(
        "--dashboard",
        action="store_true",
        help="serve a page on 127.0.0.1 that shows the run in a browser: live graph, fields over"
        " time, images, logs, load; it can pause, step and stop the run. Its address is printed",
    )
    launch.add_argument(
        "--dashboard-port",
        type=int,
        metavar="PORT",
        help="the port of the dashboard, which this switches on (default: any free one)",
    )


def add_dashboard(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The program that serves it; ``launch`` starts it, not people."""
    dashboard = commands.add_parser("dashboard", add_help=False)
    dashboard.add_argument("run")
    dashboard.set_defaults(command=_run_dashboard)


def dashboard_of(options: argparse.Namespace, *, is_wanted: bool) -> DashboardProcess | None:
    """What the command line asks for, listening already. Raises ``UsageError``.

    ``is_wanted``: something else has to be shown there.
    """
    if not (options.dashboard or is_wanted) and options.dashboard_port is None:
        return None
    from neuros.backends.dashboard import DashboardProcess

    return DashboardProcess(options.dashboard_port or 0)


def start_dashboard(
    dashboard: DashboardProcess,
    plan: Plan,
    run_id: str,
    run_folder: Path,
    logs: Mapping[str, Path],
    environment: Mapping[str, str],
) -> int:
    """Start the process for a run that has a control socket; returns its id."""
    from neuros.viewers.dashboard.plan import plan as shown_plan

    return dashboard.start(
        [sys.executable, "-m", "neuros.cli", "dashboard", str(run_folder)],
        run_folder,
        environment,
        {
            "run": run_id,
            "plan": shown_plan(plan.project, plan.names),
            "names": plan.names,
            "logs": {name: str(path) for name, path in logs.items()},
            "is_one_process": plan.back_end.is_one_process,
            "start_s": time.monotonic(),
        },
    )


def _run_dashboard(options: argparse.Namespace) -> int:
    told = json.loads(sys.stdin.readline())
    listening = socket.socket(fileno=told["descriptor"])
    if not _is_looked_at(listening):
        return 0
    # Loading all this takes a fifth of a second of a core that the nodes can use.
    import asyncio

    from neuros.viewers.dashboard.server import Dashboard

    names = tuple(told["names"])
    dashboard = Dashboard(told["plan"], names, _sources(told, names), told["start_s"])
    asyncio.run(dashboard.serve(listening, told["token"], told["run"], Path(options.run)))
    return 0


def _is_looked_at(listening: socket.socket) -> bool:
    """Wait until a browser opens the page; False if the run ends before."""
    readable, _, _ = select.select([listening, sys.stdin], [], [])
    return listening in readable


def _sources(told: Mapping[str, Any], names: tuple[str, ...]) -> Sources:
    from neuros.api.observation import owner_of_processes
    from neuros.recording.load import LAUNCHER, LoadMeter, LoadNow
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
