"""Feed of a Rerun viewer with samples of a run's packets."""

from __future__ import annotations

import base64
import io
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from neuros_dashboard.visual_types import Mark, Numbers, Picture, Points, Pose, VisualTypes

_TIMELINE = "time"
_TRAIL = 1000
_HALF_SIZES = [[0.12, 0.08, 0.05]]  # of the box that stands for a pose, metres
_AXES_M = 0.3
# The places of red, green, blue (and alpha) among the channels, by encoding.
_COLOURS = {
    "rgb8": (0, 1, 2),
    "8UC3": (0, 1, 2),
    "bgr8": (2, 1, 0),
    "rgba8": (0, 1, 2, 3),
    "bgra8": (2, 1, 0, 3),
}
_DEPTHS = {"mono8": np.uint8, "8UC1": np.uint8, "mono16": np.uint16, "16UC1": np.uint16}


class RerunFeed:
    """Logs marks to a Rerun server.

    Args:
        sources: by ``node.port``.
    """

    def __init__(self, project: str, url: str, sources: Mapping[str, VisualTypes]) -> None:
        self._trails: dict[str, deque[tuple[float, ...]]] = {}
        self._recording = rr.RecordingStream(f"neuros_{project}")
        self._recording.connect_grpc(url, default_blueprint=_blueprint(sources))

    def show(self, name: str, time_s: float, marks: Sequence[Mark]) -> None:
        """Show the marks of packets of ``node.port`` up to ``time_s``."""
        path = name.replace(".", "/", 1)
        for mark in marks:
            self._recording.set_time(_TIMELINE, duration=getattr(mark, "time_s", time_s))
            if isinstance(mark, Pose):
                self._show_pose(path, mark)
            elif isinstance(mark, Points):
                self._recording.log(f"world/{path}", rr.Points3D(mark.positions, radii=0.02))
            elif isinstance(mark, Numbers):
                for field, value in mark.values.items():
                    self._recording.log(f"numbers/{path}/{field}", rr.Scalars(value))
            elif isinstance(mark, Picture):
                self._recording.log(f"images/{path}", _image(mark.image))

    def close(self) -> None:
        """Flush the last marks, and disconnect."""
        self._recording.disconnect()

    def _show_pose(self, path: str, pose: Pose) -> None:
        entity = f"world/{path}"
        if entity not in self._trails:
            self._trails[entity] = deque(maxlen=_TRAIL)
            self._recording.log(
                entity, rr.Boxes3D(half_sizes=_HALF_SIZES), rr.TransformAxes3D(_AXES_M), static=True
            )
        self._recording.log(
            entity, rr.Transform3D(translation=pose.position, quaternion=pose.orientation)
        )
        trail = self._trails[entity]
        if not trail or trail[-1] != pose.position:
            trail.append(pose.position)
            if len(trail) > 1:
                self._recording.log(f"world/trails/{path}", rr.LineStrips3D([list(trail)]))


def _image(image: Mapping[str, Any]) -> Any:
    data, encoding = base64.b64decode(image["data"]), image["encoding"]
    if not image["width"]:
        return rr.EncodedImage(contents=io.BytesIO(data))
    size = (image["height"], image["width"])
    if encoding in _COLOURS:
        places = _COLOURS[encoding]
        return rr.Image(np.frombuffer(data, np.uint8).reshape(*size, len(places))[..., places])
    if encoding == "32FC1":
        return rr.DepthImage(np.frombuffer(data, np.float32).reshape(size))
    pixels = np.frombuffer(data, _DEPTHS[encoding]).reshape(size)
    return rr.DepthImage(pixels) if pixels.dtype == np.uint16 else rr.Image(pixels)


def _blueprint(sources: Mapping[str, VisualTypes]) -> Any:
    """A layout with the world to the left, images and curves to the right, as far as they exist."""
    left: list[Any] = []
    if any(source.is_in_space for source in sources.values()):
        left.append(rrb.Spatial3DView(origin="world", name="world"))
    paths = {name: name.replace(".", "/", 1) for name in sources}
    right: list[Any] = [
        rrb.Spatial2DView(origin=f"images/{paths[name]}", name=name)
        for name, source in sources.items()
        if source.is_image
    ]
    right += [
        rrb.TimeSeriesView(origin=f"numbers/{paths[name]}", name=name)
        for name, source in sources.items()
        if source.has_numbers
    ]
    columns = [*left, *([rrb.Vertical(*right)] if right else [])]
    return rrb.Blueprint(rrb.Horizontal(*columns), collapse_panels=True)
