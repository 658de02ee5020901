"""Distances: laser scans, depth images, point clouds, and the geometry of cameras.

Distances are metres. As in REP 117, ``inf`` is "nothing within range", ``-inf`` "too close".
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import mujoco
import numpy as np
import numpy.typing as npt

from neuros.ports import Packet
from neuros.simulators.mujoco.lookup import Problems
from neuros.simulators.mujoco.sensor_base import PICTURE, Key, Sensor, set_header

_POINT_BYTES = 12


class Lidar(Sensor):
    """A laser scanner at a site or body: beams in its x-y plane, counter-clockwise, 0 along x.

    Geoms of the element's own body are not seen.
    """

    kind = "lidar"
    types = ("sensor_msgs/msg/LaserScan",)
    sorts = ("site", "body")
    keys: ClassVar[Mapping[str, Key]] = MappingProxyType(
        {
            "beams": Key(360, "a number of beams from 2 to 100000", True, 2, 100_000),
            "angle_min": Key(-math.pi, "an angle in radians"),
            "angle_max": Key(math.pi, "an angle in radians"),
            "range_min": Key(0.0, "a distance in metres", least=0.0),
            "range_max": Key(10.0, "a distance in metres", least=0.0),
        }
    )

    def bind(self, problems: Problems) -> None:
        sort, index = self.elements[0]
        self._is_site = sort == "site"
        self._index = index
        self._body = int(self.model.site_bodyid[index]) if self._is_site else index
        options = self.declared.options
        for low, high in (("angle_min", "angle_max"), ("range_min", "range_max")):
            if not options[low] < options[high]:
                text = f"{options[high]:g} is not above {low}, which is {options[low]:g}"
                problems.add(f"{self.declared.pointer}/{high}", text)
        angles = np.linspace(options["angle_min"], options["angle_max"], int(options["beams"]))
        self._beams = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        options, count = self.declared.options, len(self._beams)
        set_header(packet.header, time_ns, self.declared.elements[0])
        packet.angle_min, packet.angle_max = options["angle_min"], options["angle_max"]
        packet.angle_increment = (packet.angle_max - packet.angle_min) / (count - 1)
        packet.scan_time = 1 / self.declared.rate_hz
        packet.range_min, packet.range_max = options["range_min"], options["range_max"]
        origins, axes = (data.xpos, data.xmat)
        if self._is_site:
            origins, axes = data.site_xpos, data.site_xmat
        beams = self._beams @ axes[self._index].reshape(3, 3).T
        found, hit = np.empty(count), np.empty(count, np.int32)
        mujoco.mj_multiRay(
            *(self.model, data, origins[self._index], beams.ravel(), None, 1, self._body),
            *(hit, found, None, count, packet.range_max),
        )
        found[(found < 0) | (found > packet.range_max)] = np.inf
        found[found < packet.range_min] = -np.inf
        packet.ranges = array("f", found.astype(np.float32).tobytes())


class _Pinhole(Sensor):
    """A camera of the model as a pinhole: its intrinsic matrix, in pixels."""

    sorts = ("camera",)
    keys = PICTURE

    def bind(self, problems: Problems) -> None:
        model, camera = self.model, self.elements[0][1]
        if model.cam_projection[camera] != mujoco.mjtProjection.mjPROJ_PERSPECTIVE.value:
            text = "an orthographic camera is no pinhole: it has no depth and no camera info"
            problems.add(f"{self.declared.pointer}/element", text)
        width, height = self.declared.width, self.declared.height
        sensor_m = model.cam_sensorsize[camera]
        # The middle of the first pixel is 0, as in OpenCV.
        self._cx, self._cy = (width - 1) / 2, (height - 1) / 2
        if sensor_m[1]:
            fx_m, fy_m, cx_m, cy_m = model.cam_intrinsic[camera].tolist()
            self._fx, self._fy = fx_m / sensor_m[0] * width, fy_m / sensor_m[1] * height
            self._cx -= cx_m / sensor_m[0] * width
            self._cy -= cy_m / sensor_m[1] * height
        else:
            half = math.radians(float(model.cam_fovy[camera])) / 2
            self._fx = self._fy = height / 2 / math.tan(half)


class CameraInfo(_Pinhole):
    """The geometry of a camera: a pinhole without distortion, as image_pipeline has it."""

    kind = "camera_info"
    types = ("sensor_msgs/msg/CameraInfo",)

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        set_header(packet.header, time_ns, self.declared.elements[0])
        packet.width, packet.height = self.declared.width, self.declared.height
        packet.distortion_model, packet.d = "plumb_bob", [0.0] * 5
        fx, fy, cx, cy = self._fx, self._fy, self._cx, self._cy
        packet.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        packet.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        packet.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]


class Depth(_Pinhole):
    """Depth of a camera's pixels: an image (32FC1, along the optical axis), or points in its frame.

    Points are rows of x (right), y (down) and z (forward), as many as pixels; NaN where nothing is.
    """

    kind = "depth"
    types = ("sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2")
    is_rendered = True

    def bind(self, problems: Problems) -> None:
        super().bind(problems)
        width, height = self.declared.width, self.declared.height
        self._right = (np.arange(width, dtype=np.float32) - self._cx) / self._fx
        self._down = ((np.arange(height, dtype=np.float32) - self._cy) / self._fy)[:, None]

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        width, height = self.declared.width, self.declared.height
        set_header(packet.header, time_ns, self.declared.elements[0])
        depth = self.cameras.depth(data, self.elements[0][1], width, height)
        packet.width, packet.height = width, height
        if self.declared.type.endswith("Image"):
            packet.encoding, packet.step = "32FC1", 4 * width
            packet.data = array("B", depth.tobytes())
            return
        from sensor_msgs.msg import PointField

        packet.point_step, packet.row_step = _POINT_BYTES, _POINT_BYTES * width
        packet.fields = [
            PointField(name=name, offset=4 * place, datatype=PointField.FLOAT32, count=1)
            for place, name in enumerate("xyz")
        ]
        packet.data = array("B", self._points(depth).tobytes())

    def _points(self, depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Shape (height, width, 3)."""
        forward = np.where(np.isfinite(depth), depth, np.float32(np.nan))
        points = [self._right * forward, self._down * forward, forward]
        return np.stack(points, axis=-1).astype(np.float32)
