"""Viewers in windows: rqt_graph and rviz2 of a ROS distribution, where there is a display."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import requests
from docker.errors import DockerException, ImageNotFound

from neuros.backends.docker import leftovers
from neuros.backends.docker.engine import connect, engine_faults, engine_socket
from neuros.backends.docker.leftovers import RUN_LABEL
from neuros.backends.docker.settings import X11, mount
from neuros.backends.run_processes import RUN_ID
from neuros.backends.sidecars import start_sidecar
from neuros.distribution import build_command
from neuros.errors import EnvironmentFault
from neuros.ordinary_files import write_whole
from neuros.ports import BackEnd, Guardian, Shown
from neuros.project.model import Port, Project
from neuros_dashboard.viewer import Viewer

RVIZ_FILE = "project.rviz"
TOOL_IMAGE = "neuros_tools"
_STOP_S = 2
_END_S = 2.0

DISPLAYS = {
    "geometry_msgs/msg/AccelStamped": "Accel",
    "geometry_msgs/msg/PointStamped": "PointStamped",
    "geometry_msgs/msg/PolygonStamped": "Polygon",
    "geometry_msgs/msg/PoseArray": "PoseArray",
    "geometry_msgs/msg/PoseStamped": "Pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "PoseWithCovariance",
    "geometry_msgs/msg/TwistStamped": "TwistStamped",
    "geometry_msgs/msg/WrenchStamped": "Wrench",
    "nav_msgs/msg/GridCells": "GridCells",
    "nav_msgs/msg/OccupancyGrid": "Map",
    "nav_msgs/msg/Odometry": "Odometry",
    "nav_msgs/msg/Path": "Path",
    "sensor_msgs/msg/FluidPressure": "FluidPressure",
    "sensor_msgs/msg/Illuminance": "Illuminance",
    "sensor_msgs/msg/Image": "Image",
    "sensor_msgs/msg/LaserScan": "LaserScan",
    "sensor_msgs/msg/PointCloud": "PointCloud",
    "sensor_msgs/msg/PointCloud2": "PointCloud2",
    "sensor_msgs/msg/Range": "Range",
    "sensor_msgs/msg/RelativeHumidity": "RelativeHumidity",
    "sensor_msgs/msg/Temperature": "Temperature",
    "visualization_msgs/msg/Marker": "Marker",
    "visualization_msgs/msg/MarkerArray": "MarkerArray",
}
"""The class of ``rviz_default_plugins`` for each message type."""

_FIXED_FRAME = "map"
_TOOLS = ("Interact", "MoveCamera", "Select", "FocusCamera", "Measure")


class ToolProcess:
    """A tool as a process of this machine, with the environment of a run.

    Raises:
        EnvironmentFault: the process cannot be started.
    """

    def __init__(self, program: str, command: Sequence[str], run: Shown) -> None:
        log = run.folder / f"{program}.log"
        self._process = start_sidecar(program, command, log, run.environment, is_ours=False)

    def finish(self) -> None:
        self._process.terminate()
        end_process(self._process, _END_S)


class ToolContainer:
    """A tool in a container with the host's network and display, and the run folder.

    Raises:
        EnvironmentFault: the container cannot be started.
    """

    def __init__(
        self, program: str, arguments: Sequence[str], run: Path, environment: Mapping[str, str]
    ) -> None:
        self._engine = connect()
        passed = {key: os.environ[key] for key in ("DISPLAY", "XAUTHORITY") if key in os.environ}
        seen = [run, X11, *map(Path, filter(None, [passed.get("XAUTHORITY")]))]
        with engine_faults(f"{program} in a container of {TOOL_IMAGE}"):
            self._container = self._engine.containers.run(
                TOOL_IMAGE,
                [program, *arguments],
                detach=True,
                auto_remove=True,
                environment={**environment, **passed, "HOME": "/tmp", "ROS_LOG_DIR": "/tmp"},
                labels={RUN_LABEL: environment.get(RUN_ID, ""), "neuros.run_folder": str(run)},
                mounts=[mount(path, path) for path in seen if path.exists()],
                network_mode="host",
                ipc_mode="host",
                user=f"{os.getuid()}:{os.getgid()}",
                cap_drop=["ALL"],
                security_opt=["no-new-privileges"],
            )

    def announce(self, guardian: Guardian) -> None:
        """Have the container removed if the launcher is killed."""
        guardian.clean_with(leftovers.__name__, engine_socket(self._engine))

    def finish(self) -> None:
        with contextlib.suppress(DockerException, requests.RequestException):
            self._container.stop(timeout=_STOP_S)  # fails if the user has closed the window
        self._engine.close()


def end_process(process: subprocess.Popen[bytes], patience_s: float) -> None:
    """Wait for the end of a sidecar process; kill it after ``patience_s``."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(patience_s)
    process.kill()  # has no effect on a process that has ended
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(BrokenPipeError):
                pipe.close()


class _Window:
    """A tool on a run; ``path`` is its program, ``None`` for the image ``neuros_tools``."""

    def __init__(
        self, program: str, path: str | None, arguments: Callable[[Shown], Sequence[str]]
    ) -> None:
        self._program, self._path, self._arguments = program, path, arguments
        self._running: ToolProcess | ToolContainer | None = None

    def start(self, run: Shown, guardian: Guardian) -> str:
        arguments = self._arguments(run)
        if self._path is None:
            self._running = ToolContainer(self._program, arguments, run.folder, run.environment)
            self._running.announce(guardian)
        else:
            self._running = ToolProcess(self._program, [self._path, *arguments], run)
        return f"{self._program}: a window on this display"

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
        return _Window(self.name, find_tool(self.name), self._arguments)


def _configured(run: Shown) -> Sequence[str]:
    path = run.folder / RVIZ_FILE
    write_whole(path, rviz_configuration(run.project).encode())
    return ["-d", str(path)]


RQT_GRAPH = _ToolViewer("rqt_graph", {"graph": 1}, lambda _: [])
RVIZ = _ToolViewer("rviz2", {"packets": 1}, _configured)


def has_display(environ: Mapping[str, str] = os.environ) -> bool:
    """Whether windows can be opened."""
    return bool(environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY"))


def open_page(url: str) -> None:
    """Open a page in a browser if there is a display."""
    import webbrowser

    if has_display():
        webbrowser.open(url)


def find_tool(program: str, environ: Mapping[str, str] = os.environ) -> str | None:
    """The path of a tool, ``None`` if it is in the image ``neuros_tools``.

    Raises ``EnvironmentFault`` with a short reason where the tool cannot run.
    """
    if not has_display(environ):
        raise EnvironmentFault(f"{program} needs a display")
    path = shutil.which(program, path=environ.get("PATH"))
    if path is None and (reason := find_tool_image(environ)):
        raise EnvironmentFault(f"{program} is not on PATH, and {reason}")
    return path


def find_tool_image(environ: Mapping[str, str] = os.environ) -> str | None:
    """``None`` if the image exists, else a short reason."""
    try:
        with contextlib.closing(connect(environ)) as engine:
            engine.images.get(TOOL_IMAGE)
    except EnvironmentFault:
        return f"there is no Docker engine for the image {TOOL_IMAGE}"
    except ImageNotFound:
        return f"the image {TOOL_IMAGE} is not built ({build_command(TOOL_IMAGE)})"
    except (DockerException, requests.RequestException) as error:
        return f"the Docker engine does not say whether it has the image {TOOL_IMAGE}: {error}"
    return None


def rviz_configuration(project: Project) -> str:
    """The content of a ``.rviz`` file; connections of types without a display are left out."""
    displays = [_display("Grid", "Grid"), _display("TF", "TF"), *_displays(project)]
    configuration = {
        "Panels": [
            {"Class": "rviz_common/Displays", "Name": "Displays"},
            {"Class": "rviz_common/Time", "Name": "Time"},
            {"Class": "rviz_common/Views", "Name": "Views"},
        ],
        "Visualization Manager": {
            "Class": "",
            "Displays": displays,
            "Enabled": True,
            "Global Options": {"Fixed Frame": _FIXED_FRAME, "Frame Rate": 30},
            "Name": "root",
            "Tools": [{"Class": f"rviz_default_plugins/{name}"} for name in _TOOLS],
            "Value": True,
            "Views": {
                "Current": {
                    "Class": "rviz_default_plugins/Orbit",
                    "Distance": 5,
                    "Name": "Current View",
                },
                "Saved": None,
            },
        },
        "Window Geometry": {"Width": 1400, "Height": 900},
    }
    return json.dumps(configuration, indent=2) + "\n"


def _displays(project: Project) -> Iterator[dict[str, Any]]:
    shown: dict[str, tuple[Port, str]] = {}  # one connection of an output is enough
    for connection in project.connections:
        port = project.node(connection.source_node).output(connection.source_output)
        name = f"{connection.source_node}.{port.name}"
        shown.setdefault(name, (port, f"{connection.topic}/data"))
    for node in project.nodes:
        for port in (*node.inputs, *node.outputs):
            if port.external_topic is not None:
                topic = project.names.resolve(port.external_topic, node.name)
                shown.setdefault(topic, (port, topic))
    for name, (port, topic) in shown.items():
        if port.type in DISPLAYS:
            yield _display(DISPLAYS[port.type], name, topic)


def _display(kind: str, name: str, topic: str | None = None) -> dict[str, Any]:
    display: dict[str, Any] = {
        "Class": f"rviz_default_plugins/{kind}",
        "Enabled": True,
        "Name": name,
        "Value": True,
    }
    if topic is not None:
        # Best effort, so that no sender ever waits for a window.
        display["Topic"] = {
            "Depth": 5,
            "Durability Policy": "Volatile",
            "History Policy": "Keep Last",
            "Reliability Policy": "Best Effort",
            "Value": topic,
        }
    return display
