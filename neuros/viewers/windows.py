"""Viewers in windows: rqt_graph and rviz2 of a ROS distribution, where there is a display."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuros.backends.docker.launcher import ToolContainer, find_tool_image
from neuros.backends.sidecars import start_sidecar
from neuros.errors import EnvironmentFault
from neuros.ports import BackEnd, Reaper
from neuros.project.model import Project
from neuros.viewers.viewer import Shown, Viewer

RVIZ_FILE = "project.rviz"
_END_S = 2.0
_MOST_WAIT_S = 5.0

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
"""By message type, the class of ``rviz_default_plugins`` that shows it."""

_FIXED_FRAME = "map"
_TOOLS = ("Interact", "MoveCamera", "Select", "FocusCamera", "Measure")


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


def rviz_configuration(project: Project) -> str:
    """The content of a ``.rviz`` file; connections of types that it does not show are left out."""
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
    seen: set[str] = set()
    for connection in project.connections:
        port = project.node(connection.source_node).output(connection.source_output)
        name = f"{connection.source_node}.{port.name}"
        if port.type in DISPLAYS and name not in seen:  # one connection of an output is enough
            seen.add(name)
            yield _display(DISPLAYS[port.type], name, f"{connection.topic}/data")
    for node in project.nodes:
        for port in (*node.inputs, *node.outputs):
            if port.external_topic is None or port.type not in DISPLAYS:
                continue
            topic = project.names.resolve(port.external_topic, node.name)
            if topic not in seen:
                seen.add(topic)
                yield _display(DISPLAYS[port.type], topic, topic)


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
