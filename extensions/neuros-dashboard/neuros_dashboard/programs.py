"""Programs beside a run: ``dashboard`` serves its page, ``rerun`` and ``foxglove`` feed viewers.

The first line of their standard input has their settings as JSON.
"""

from __future__ import annotations

import json
import os
import select
import socket
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_LAST_LOG_BYTES = 1 << 16
_FOXGLOVE_S = 0.1


def feed_rerun() -> None:
    """Send samples of the run's packets to Rerun until the run is over."""
    from neuros.backends.control_sockets import connect_by
    from neuros.control import TO_OBSERVERS
    from neuros.control.link import ControlLink
    from neuros_dashboard.rerun_feed import RerunFeed
    from neuros_dashboard.visual_types import VisualTypes, observe
    from neuros_dashboard.web import await_server
    from neuros_dashboard.windows import open_page

    told = json.loads(sys.stdin.readline())
    sources = {
        each["name"]: (each["node"], each["port"], VisualTypes(each["type"]))
        for each in told["sources"]
    }
    await_server(told["url"])
    open_page(told["url"])
    feed = RerunFeed(
        told["project"], told["feed_url"], {name: source for name, (*_, source) in sources.items()}
    )
    link = ControlLink(connect_by(os.environ), TO_OBSERVERS, "the supervisor")
    observe(link, sources, feed.show)
    feed.close()


def serve_foxglove() -> None:
    """Serve Foxglove apps until the run is over."""
    from neuros.api.observation import answers
    from neuros.backends.control_sockets import connect_by
    from neuros.control import TO_OBSERVERS
    from neuros.control.link import ControlLink
    from neuros_dashboard.foxglove_feed import FoxgloveFeed

    told = json.loads(sys.stdin.readline())
    feed = FoxgloveFeed(
        *(told["project"], told["host"], told["port"], told["names"], told["sources"])
    )
    logs = {name: Path(path) for name, path in told["logs"].items()}
    log: _Log | None = None
    link = ControlLink(connect_by(os.environ), TO_OBSERVERS, "the supervisor")
    try:
        for message in answers(link, feed.ask, _FOXGLOVE_S):
            if message is not None:
                feed.handle(message)
            elif feed.wants_log:
                log = log or _Log(logs)
                feed.show_log(log.read())
            elif log is not None:
                log.close()
                log = None
        if log is not None:
            feed.show_log(log.read())
    finally:
        feed.close()


def serve_dashboard() -> None:
    """Serve the page until the run is over."""
    told = json.loads(sys.stdin.readline())
    listening = socket.socket(fileno=told["descriptor"])
    # Wait until a browser opens the page, or the run ends.
    readable, _, _ = select.select([listening, sys.stdin], [], [])
    if listening not in readable:
        return
    # Importing the server takes 0.2 s of a core that the nodes can use.
    import asyncio

    asyncio.run(_serve(told, listening))


async def _serve(told: Mapping[str, Any], listening: socket.socket) -> None:
    from neuros.api.observation import owner_of_processes
    from neuros.backends.control_sockets import connect_by
    from neuros.control import TO_OBSERVERS
    from neuros.control.link import ControlLink
    from neuros.recording.system_load import LoadMeter
    from neuros_dashboard.live_metrics import Load, ObservedRun
    from neuros_dashboard.pages import Pages
    from neuros_dashboard.server import Dashboard

    names, pages = tuple(told["names"]), Pages()
    link = ControlLink(connect_by(os.environ), TO_OBSERVERS, "the supervisor")
    run = ObservedRun(pages, link, names, told["start_s"])
    logs = {name: Path(path) for name, path in told["logs"].items()}
    owner = owner_of_processes(told["run"], names, is_one_process=told["is_one_process"])
    load = Load(LoadMeter(owner))
    dashboard = Dashboard(told["plan"], lambda: _Log(logs), load, pages, run)
    await dashboard.serve(listening, told["token"], told["run"])


class _Log:
    """New lines of the logs of a run, in the form of the console."""

    def __init__(self, files: Mapping[str, Path]) -> None:
        from neuros.backends.console import LogTail

        self._lines: list[str] = []
        self._tail = LogTail(
            files,
            lambda text: self._lines.extend(text.splitlines()),
            colours=False,
            last_bytes=_LAST_LOG_BYTES,
        )

    def read(self) -> list[str]:
        self._tail.poll()
        lines, self._lines = self._lines, []
        return lines

    def close(self) -> None:
        self._tail.close()


if __name__ == "__main__":
    {"dashboard": serve_dashboard, "rerun": feed_rerun, "foxglove": serve_foxglove}[sys.argv[1]]()
