"""Visual types: poses, points, numbers and pictures that viewers show of a run's packets.

Poses and scans share one world; images are beside it, and other numbers are curves. Of an unknown
message type the first numbers are shown, whose fields its first sample tells.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neuros.api.observation import statuses
from neuros.control.link import ControlLink
from neuros.project.dashboard import IMAGES

MOST_NUMBERS = 16
_MOST_BEAMS = 1500
_PERIOD_S = 0.2
_XYZ, _XYZW = ("x", "y", "z"), ("x", "y", "z", "w")

# Prefixes of position and orientation; "" for a missing one.
_POSES = {
    "geometry_msgs/msg/Point": (".", ""),
    "geometry_msgs/msg/PointStamped": ("point.", ""),
    "geometry_msgs/msg/Pose": ("position.", "orientation."),
    "geometry_msgs/msg/PoseStamped": ("pose.position.", "pose.orientation."),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "pose.pose.position.",
        "pose.pose.orientation.",
    ),
    "geometry_msgs/msg/Quaternion": ("", "."),
    "geometry_msgs/msg/QuaternionStamped": ("", "quaternion."),
    "geometry_msgs/msg/Transform": ("translation.", "rotation."),
    "geometry_msgs/msg/TransformStamped": ("transform.translation.", "transform.rotation."),
    "nav_msgs/msg/Odometry": ("pose.pose.position.", "pose.pose.orientation."),
    "sensor_msgs/msg/Imu": ("", "orientation."),
}
# Further fields to show; none of the time, which every packet has.
_NUMBERS: dict[str, list[str]] = {
    "rosgraph_msgs/msg/Clock": [],
    "sensor_msgs/msg/Imu": [
        f"{part}.{axis}" for part in ("angular_velocity", "linear_acceleration") for axis in _XYZ
    ],
}
_NOT_FINITE = ("nan", "inf", "-inf")  # in samples; the next value may be a number
_SCAN = "sensor_msgs/msg/LaserScan"


@dataclass(frozen=True)
class Pose:
    """Position in metres and orientation (x, y, z, w) at a time, seconds."""

    time_s: float
    position: tuple[float, ...]
    orientation: tuple[float, ...]


@dataclass(frozen=True)
class Points:
    """Points in the plane of a scan, metres."""

    positions: Sequence[tuple[float, float, float]]


@dataclass(frozen=True)
class Numbers:
    """Numeric fields of a packet at a time, seconds."""

    time_s: float
    values: Mapping[str, float]


@dataclass(frozen=True)
class Picture:
    """An image, in the encoding of :mod:`neuros.node.sampling`."""

    image: Mapping[str, Any]


Mark = Pose | Points | Numbers | Picture


class VisualTypes:
    """Visual types of one output or external input."""

    def __init__(self, type_name: str) -> None:
        self.is_image = type_name in IMAGES
        self.is_scan = type_name == _SCAN
        self._position, self._orientation = _POSES.get(type_name, ("", ""))
        self.is_in_space = bool(self._position or self._orientation or self.is_scan)
        self._numbers: list[str] | None = _NUMBERS.get(type_name)
        if self._numbers is None and (self.is_in_space or self.is_image):
            self._numbers = []

    @property
    def has_numbers(self) -> bool:
        """Whether the type has curves, or may have."""
        return self._numbers is None or bool(self._numbers)

    def wanted(self) -> dict[str, Any]:
        """Fields to sample next (see :class:`neuros.node.sampling.Sampler`)."""
        if self.is_image:
            return {"image": True}
        if self.is_scan:
            return {"all": True, "most_elements": _MOST_BEAMS}
        if self._numbers is None:
            return {"all": True}
        return {"fields": [*self._pose_fields(), *self._numbers]}

    def marks(self, sample: Mapping[str, Any]) -> Iterator[Mark]:
        if "image" in sample:
            yield Picture(sample["image"])
        if "all" in sample:
            if self.is_scan:
                yield Points(_beams(sample["all"]))
            elif self._numbers is None:
                # The first numbers that are the message's own.
                self._numbers = [
                    path
                    for path, value in sample["all"].items()
                    if (isinstance(value, int | float) or value in _NOT_FINITE)
                    and not path.startswith("header.")
                    and not path.endswith(".length")
                    and "covariance" not in path
                ][:MOST_NUMBERS]
        for row in sample.get("values", ()):
            yield from self._of_row(row[0], dict(zip(sample["fields"], row[1:], strict=True)))

    def _of_row(self, time_s: float, values: Mapping[str, float | None]) -> Iterator[Mark]:
        if self._position or self._orientation:
            position = _vector(values, self._position, _XYZ) or (0.0, 0.0, 0.0)
            orientation = _vector(values, self._orientation, _XYZW)
            if orientation is None or not any(orientation):  # all zeros: the message was not filled
                orientation = (0.0, 0.0, 0.0, 1.0)
            yield Pose(time_s, position, orientation)
        numbers = {
            name: value for name in self._numbers or () if (value := values[name]) is not None
        }
        if numbers:
            yield Numbers(time_s, numbers)

    def _pose_fields(self) -> list[str]:
        parts = ((self._position, _XYZ), (self._orientation, _XYZW))
        return [f"{prefix}{axis}".lstrip(".") for prefix, axes in parts if prefix for axis in axes]


def _vector(
    values: Mapping[str, float | None], prefix: str, axes: Sequence[str]
) -> tuple[float, ...] | None:
    """Numeric fields as a tuple; ``None`` where one is missing or not a number."""
    if not prefix:
        return None
    found = [values.get(f"{prefix}{axis}".lstrip(".")) for axis in axes]
    numbers = tuple(each for each in found if each is not None)
    return numbers if len(numbers) == len(axes) else None


def _beams(scan: Mapping[str, Any]) -> list[tuple[float, float, float]]:
    points = []
    angle, step = scan["angle_min"], scan["angle_increment"]
    for place in range(_MOST_BEAMS):
        distance = scan.get(f"ranges[{place}]")
        if distance is None:
            break
        if not isinstance(distance, str) and scan["range_min"] <= distance <= scan["range_max"]:
            direction = angle + place * step
            points.append((distance * math.cos(direction), distance * math.sin(direction), 0.0))
    return points


def observe(
    link: ControlLink,
    sources: Mapping[str, tuple[str, str, VisualTypes]],
    show: Callable[[str, float, Sequence[Mark]], None],
) -> None:
    """Ask for samples of packets until the run is over.

    Args:
        link: to the supervisor; closed at the end.
        sources: node, port and visual types, by name.
        show: called with a name, the time since the start in seconds, and the new marks.
    """
    names = {(node, port): name for name, (node, port, _) in sources.items()}
    begin_s = time.monotonic()

    def wanted() -> dict[str, dict[str, Any]]:
        found: dict[str, dict[str, Any]] = {}
        for node, port, source in sources.values():
            found.setdefault(node, {})[port] = source.wanted()
        return found

    for status in statuses(link, wanted, _PERIOD_S):
        for port, sample in status.samples.items():
            name = names[status.node, port]
            for row in sample.get("values", ()):
                row[0] -= begin_s
            marks = sources[name][2].marks(sample)
            show(name, time.monotonic() - begin_s, list(marks))
