"""Cameras, also those of which MuJoCo shows the colours only."""

from __future__ import annotations

import math

import numpy as np

from neuros.convert.building import Building, put
from neuros.convert.elements import Element
from neuros.convert.numbers import number
from neuros.convert.poses import Pose
from neuros.convert.scopes import Link

# SDF's cameras look along x, with z up; MuJoCo's along -z, with y up.
_TO_CAMERA = Pose(rotation=np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]))

CAMERAS = {
    "camera": "",
    "wideanglecamera": "a pinhole camera in MuJoCo, without the wide angle lens",
    "wide_angle_camera": "a pinhole camera in MuJoCo, without the wide angle lens",
    "depth": "colours only, no depth",
    "depth_camera": "colours only, no depth",
    "rgbd": "colours only, no depth",
    "rgbd_camera": "colours only, no depth",
}


def add_camera(building: Building, link: Link, element: Element, pose: Pose) -> None:
    """Add the camera of a sensor, whose own pose in the world is ``pose``."""
    report = building.report
    kind = element.attributes.get("type", "")
    settings = element.child("camera")
    width, height, across = 320.0, 240.0, 1.047
    if settings is not None:
        pose = link.scope.read_pose(settings, pose)
        across = number(settings, "horizontal_fov", report, across, positive=True)
        image = settings.child("image")
        if image is not None:
            width = number(image, "width", report, width, positive=True)
            height = number(image, "height", report, height, positive=True)
    if across >= math.pi:
        report.problem(settings or element, f"a field of view is below pi, not {across:g}")
        return
    camera = building.body(link).add_camera(resolution=[int(width), int(height)])
    camera.name = building.name("camera", f"{link.name}/{element.name}", element)
    camera.fovy = math.degrees(2 * math.atan(math.tan(across / 2) * height / width))
    put(camera, pose @ _TO_CAMERA, link.pose)
    if CAMERAS[kind]:
        report.remark(element, CAMERAS[kind])
