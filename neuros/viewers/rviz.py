"""Configuration of RViz for a project: a display for each connection that it can show.

The file is JSON, which is YAML, too.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from neuros.project.model import Project

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
