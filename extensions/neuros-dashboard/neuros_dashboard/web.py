"""Viewers in a browser: the dashboard and Rerun. Processes beside the run serve their pages."""

from __future__ import annotations

import contextlib
import json
import secrets
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from typing import Any
from urllib.parse import quote, urlsplit

from neuros.api.run_folder import LAUNCHER_LOG
from neuros.backends.sidecars import start_sidecar
from neuros.distribution import install_command, python_command
from neuros.errors import EnvironmentFault, UsageError
from neuros.ports import BackEnd, Guardian, Shown
from neuros.project.dashboard import ARRAYS, IMAGES, SPIKES
from neuros.project.graph import guarantee
from neuros.project.model import Node, Port, Project
from neuros.project.names import Names
from neuros.recording.system_load import LAUNCHER
from neuros_dashboard.viewer import Viewer
from neuros_dashboard.windows import end_process, open_page

HOST = "127.0.0.1"
PROGRAMS = "neuros_dashboard.programs"
_RERUN_MEMORY = "512MB"
_END_S = 3.0
_START_S, _RETRY_S = 30.0, 0.1


class _DashboardView:
    """Serves the dashboard of a run.

    The socket listens from the constructor on, so the address may be opened at once; requests wait
    until the process is started, which imports its server when the first one arrives. The process
    ends with the run, or, if no page was open, with its standard input.

    Args:
        port: on 127.0.0.1; 0: any free one.
        section: of the page; given, the page is opened there in a browser.

    Raises:
        UsageError: the port is taken.
    """

    def __init__(self, port: int, section: str | None) -> None:
        self._section = section
        self._token = secrets.token_urlsafe(24)
        self._process: subprocess.Popen[bytes] | None = None
        self._listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listening.bind((HOST, port))
        except (OSError, OverflowError) as error:
            self._listening.close()
            raise UsageError(
                f"--dashboard-port {port}: this port cannot be used ({error}); name another one, or"
                " leave the option out for any free one"
            ) from error
        self._listening.listen(64)
        # The token in it admits the reader.
        self._url = f"http://{HOST}:{self._listening.getsockname()[1]}/?token={self._token}"

    def start(self, run: Shown, guardian: Guardian) -> str:
        command = python_command(PROGRAMS, "dashboard", str(run.folder))
        descriptor, log = self._listening.fileno(), run.folder / "dashboard.log"
        self._process = process = start_sidecar(
            "dashboard", command, log, run.environment, [descriptor]
        )
        self._listening.close()
        _send_settings(
            process,
            {
                "run": run.run_id,
                "plan": project_view(run.project, run.names),
                "names": run.names,
                "logs": {name: str(path) for name, path in run.logs.items()}
                | {LAUNCHER: str(run.folder / LAUNCHER_LOG)},
                "is_one_process": run.is_one_process,
                "start_s": time.monotonic(),
                "token": self._token,
                "descriptor": descriptor,
            },
        )
        if self._section:
            open_page(f"{self._url}#{self._section}")
        return f"dashboard: {self._url}"

    def finish(self) -> None:
        """Close the process after its pages have the end of the run."""
        self._listening.close()
        process = self._process
        if process is None:
            return
        if process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
        end_process(process, _END_S)


class _RerunView:
    """Serves a Rerun web viewer for a run, and feeds it with samples of the run's packets."""

    def __init__(self) -> None:
        with socket.socket() as feed, socket.socket() as web:
            for each in (feed, web):
                each.bind((HOST, 0))
            self._feed_port, self._web_port = feed.getsockname()[1], web.getsockname()[1]
        self._feed_url = f"rerun+http://{HOST}:{self._feed_port}/proxy"
        self._url = f"http://{HOST}:{self._web_port}/?url={quote(self._feed_url, safe=':/')}"
        self._processes: list[subprocess.Popen[bytes]] = []

    def start(self, run: Shown, guardian: Guardian) -> str:
        server = python_command("rerun", "--serve-web", "--bind", HOST)
        server += ["--port", str(self._feed_port), "--web-viewer-port", str(self._web_port)]
        server += ["--server-memory-limit", _RERUN_MEMORY, "--hide-welcome-screen"]
        server += ["--newest-first"]  # a late viewer begins with the present
        feeder = python_command(PROGRAMS, "rerun", str(run.folder))
        log = run.folder / "rerun.log"
        for what, command in (("server of Rerun", server), ("feeder of Rerun", feeder)):
            process = start_sidecar(what, command, log, run.environment)
            self._processes.append(process)
            _send_settings(
                process,
                {
                    "project": run.project.name,
                    "sources": project_view(run.project, run.names)["sources"],
                    "feed_url": self._feed_url,
                    "url": self._url,
                },
            )
        return f"visualisations: {self._url}"

    def finish(self) -> None:
        """End the processes: the feeder by itself, then the server."""
        for process in reversed(self._processes):
            end_process(process, _END_S if process is self._processes[-1] else 0)


class _Dashboard(Viewer):
    name = "dashboard"
    place = "the dashboard"
    ranks: Mapping[str, int] = {"graph": 0}

    def prepare(self, back_end: BackEnd, subject: str | None, port: int | None) -> _DashboardView:
        return _DashboardView(port or 0, subject and f"{subject}-section")


class _Rerun(Viewer):
    name = "rerun"
    place = "Rerun"
    ranks: Mapping[str, int] = {"packets": 0}

    def prepare(self, back_end: BackEnd, subject: str | None, port: int | None) -> _RerunView:
        if find_spec("rerun") is None:
            raise EnvironmentFault(f"Rerun is not installed: {install_command('rerun')}")
        return _RerunView()


DASHBOARD = _Dashboard()
RERUN = _Rerun()


def await_server(url: str) -> None:
    """Wait until the server of a page answers. Raises ``OSError`` if it does not."""
    where = urlsplit(url)
    give_up_s = time.monotonic() + _START_S
    while True:
        try:
            socket.create_connection((HOST, where.port or 0), 1.0).close()
        except ConnectionRefusedError:
            if time.monotonic() > give_up_s:
                raise
            time.sleep(_RETRY_S)
        else:
            return


def _send_settings(process: subprocess.Popen[bytes], settings: Mapping[str, Any]) -> None:
    """Write settings to standard input: other users could read a command line."""
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write(json.dumps(settings).encode() + b"\n")
        process.stdin.flush()


# ---------------------------------------------------------------------- the project for viewers


def project_view(project: Project, names: Sequence[str]) -> dict[str, Any]:
    """The project for viewers, ready for JSON.

    Args:
        names: the nodes of this run; the others run elsewhere and cannot be sampled.
    """
    return {
        "project": project.name,
        "is_virtual": project.is_virtual,
        "dashboard": project.dashboard,
        "nodes": [
            {
                "name": node.name,
                "container": node.container,
                "is_here": node.name in names,
            }
            for node in project.nodes
        ],
        "connections": [
            {
                "name": str(connection),
                "from": connection.source_node,
                "output": connection.source_output,
                "to": connection.destination_node,
                "input": connection.destination_input,
                "discard_limit": connection.discard_limit,
                "window": connection.window,
                "guarantee": guarantee(connection),
            }
            for connection in project.connections
        ],
        "topics": list(_topics(project)),
        "sources": [
            source
            for node in project.nodes
            if node.name in names
            for source in _sources(node, project.names)
        ],
    }


def _topics(project: Project) -> Iterator[dict[str, Any]]:
    """External topics; ``name`` is from the project file, ``title`` from the ROS graph."""
    for node in project.nodes:
        for port in (*node.inputs, *node.outputs):
            if port.external_topic is not None:
                is_in, end = port in node.inputs, f"{node.name}.{port.name}"
                full = project.names.resolve(port.external_topic, node.name)
                name, title = (
                    f"{topic} -> {end}" if is_in else f"{end} -> {topic}"
                    for topic in (port.external_topic, full)
                )
                yield {
                    "name": name,
                    "title": title,
                    "topic": port.external_topic,
                    "full": full,
                    "node": node.name,
                    "is_in": is_in,
                }


def _sources(node: Node, names: Names) -> Iterator[dict[str, Any]]:
    """Ports that can be sampled: outputs and external inputs."""
    for port in node.outputs:
        yield _source(node, port, port.name, port.name)
    for port in node.inputs:
        if port.external_topic is not None:
            full = names.resolve(port.external_topic, node.name)
            yield _source(node, port, port.external_topic, full)


def _source(node: Node, port: Port, key: str, title: str) -> dict[str, Any]:
    return {
        "node": node.name,
        "port": key,
        "name": f"{node.name}.{key}",
        "title": f"{node.name}.{title}",
        "type": port.type,
        "is_image": port.type in IMAGES,
        "is_spikes": port.type == SPIKES,
        "array": ARRAYS.get(port.ros_type, ""),
    }
